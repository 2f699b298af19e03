"""What the operator `kcgs::region_splat` takes."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from kcgs.maps import MapOperands

# operands where one region covers everything
NO_MAP = (None,) * (len(MapOperands._fields) - 1)


class SplatArguments(NamedTuple):
    """The arguments of the operator, in order; floating tensors share one dtype, float32 or float64.

    For one image B may be left out of means, cholesky, colors and region_ids together, and so of the image.
    """

    means: Tensor  # [B, N, 2]
    cholesky: Tensor  # [B, N, 3]
    colors: Tensor  # [B, N, C]
    region_ids: Tensor | None  # [B, N] int64
    labels: Tensor | None  # [H, W] or [B, H, W] int64, of the map at its own size
    blurs: Tensor | None  # this and the next six: see `MapOperands`
    width_index: Tensor | None
    ids: Tensor | None
    starts: Tensor | None
    regions: Tensor | None
    planes: Tensor | None
    weights: Tensor | None
    height: int
    width: int
    cutoff: float
    backend: str

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return self.height, self.width

    @property
    def map_operands(self) -> MapOperands | None:
        """The map at the size of the image; None: one region covers everything."""
        return None if self.labels is None else MapOperands(self.labels, *self[5:12], self.size)
