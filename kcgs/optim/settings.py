"""Arguments of the compiled steps of Adam in a Gaussian's frame, on a CPU and on a GPU."""

from __future__ import annotations

from typing import Any, NamedTuple


class Adam(NamedTuple):
    """Settings of a parameter group, and the averages of its tables, side by side in K columns; arrays or tensors."""

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
