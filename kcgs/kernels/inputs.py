"""What every kernel receives: validated, batched tensors."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from .membership import Membership


class SplatInputs(NamedTuple):
    """Arguments of one splat, checked and batched by the public function.

    Floating tensors share one dtype (float32 or float64) and one device.
    """

    means: Tensor  # [B, N, 2] pixels
    cholesky: Tensor  # [B, N, 3] pixels
    colors: Tensor  # [B, N, C]
    region_index: Tensor | None  # [B, N] int64, position in the sorted list of regions; -1: not in the map
    membership: Membership | None  # None: one region covers everything
    size: tuple[int, int]  # (height, width)
    cutoff: float
