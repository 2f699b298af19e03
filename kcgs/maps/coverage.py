"""Coverage: which regions occur in which tile of a map, and how much of each pixel they hold."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Coverage(NamedTuple):
    """The regions of every tile of 16 x 16 pixels; tiles are numbered in raster order, map first."""

    starts: Tensor  # [maps * tiles + 1] int32, first entry of each tile
    regions: Tensor  # [K] int32, ascending within a tile: position among the sorted ids of the map
    planes: Tensor  # [K] int32, row of `weights`; -1 where the region is alone in its tile, with weight 1
    weights: Tensor  # [P, 256] float32, membership of the tile's pixels in the region
