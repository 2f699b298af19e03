"""What a step of Adam in a Gaussian's frame is given, compiled for a CPU or for a GPU."""

from __future__ import annotations

from typing import Any, NamedTuple


class Adam(NamedTuple):
    """Settings of a group, and the averages of its tables beside each other, K columns; arrays, or tensors."""

    lr: Any  # a number; on a GPU perhaps a tensor
    beta1: float
    beta2: float
    eps: float
    age: Any  # [N, 1]
    average: Any  # [N, K]
    square: Any  # [N, K]


class Bounds(NamedTuple):
    """Bounds of a step, in standard deviations and log scale, and of a field's geometry, in pixels."""

    max_step: float
    height: float
    width: float
    min_sigma: float
    min_factor: float
    max_outside: float  # in standard deviations
    max_factor: float
