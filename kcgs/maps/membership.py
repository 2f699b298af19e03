"""Membership s_r(x, y) of pixels in regions by its definition: tests compare tiles and kernels with it.

`RegionMap` documents the blur.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from .table import MapTable
from .tiles import with_tiles
from .widths import reach_of, truncated_gaussian


class Membership:
    """The membership of a map at its own size; the table has ids and positions."""

    margin = 0  # pixels by which the weights before the blur reach beyond a region's labels

    def __init__(self, table: MapTable) -> None:
        assert table.positions is not None
        self.table, self.index = table, table.positions
        self.widths = table.widths

    @functools.cached_property
    def tiled_table(self) -> MapTable:
        """The table with the tiles of this membership."""
        return with_tiles(self.table)

    @property
    def radius(self) -> int:
        """Reach of the softest contour in pixels."""
        return reach_of(self.widths[-1]) + self.margin

    def weights(self, batch: int, region: int, dtype: torch.dtype) -> Tensor:
        """Evaluate s_r of one region over one whole map, (H, W)."""
        inside, width_index = self._inside(batch, region), self.table.width_index
        weights = torch.zeros_like(inside)
        for position, width in enumerate(self.widths):
            blurred = _blur(inside, width)
            is_own = None if width_index is None else width_index[batch] == position
            weights = blurred if is_own is None else torch.where(is_own, blurred, weights)
        return weights.to(dtype)

    def _inside(self, batch: int, region: int) -> Tensor:
        """Return the weights of a region before the blur, (H, W) float64."""
        return (self.index[batch] == region).to(torch.float64)

    @property
    def variances(self) -> Tensor:
        """Squared widths of contours at pixels, (maps, H, W) float64."""
        blurs, width_index = self.table.blurs, self.table.width_index
        if blurs is None:
            return torch.zeros_like(self.index, dtype=torch.float64)
        squares = blurs[:, 0].square()
        return squares.expand(self.index.shape) if width_index is None else squares[width_index.long()]


def _blur(inside: Tensor, width: float) -> Tensor:
    if width == 0.0:
        return inside
    axes = [torch.arange(n, device=inside.device) for n in inside.shape]
    rows, cols = (truncated_gaussian((axis[:, None] - axis[None, :]).abs().double(), width) for axis in axes)
    total = rows.sum(1)[:, None] * cols.sum(1)[None, :]
    return (rows @ inside @ cols.T) / total
