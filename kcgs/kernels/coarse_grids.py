"""Coarse grids for wide Gaussians: they are evaluated at nodes, and cubic B-splines carry the values to the pixels.

Level l has nodes 2^l pixels apart; level 0 is the pixels. A region has blocks of 16 x 16 nodes where it has tiles.
`cpu` and the ONNX decoders use these grids; docs/performance.md has the formulas and errors.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcgs.maps import TILE

# nodes along the longer side of the coarsest grid
_COARSEST_SIDE = 2 * TILE
# spacing of nodes, in standard deviations, at cutoff 1; it grows with cutoff^(1/4), so that the error of interpolation,
# at most spacing^4 / 128, is 3.2 times the cutoff
_SPACING = 4.5
# largest spacing of nodes, in standard deviations: a spline has 0.7^2 / 3 = 0.16 of the Gaussian's variance at most
_MAX_SPACING = 0.7


class Grid(NamedTuple):
    """Nodes of a level, and the tiles that hold them, 16 x 16 each; node k of an axis lies at (k - 1) 2^l pixels."""

    height: int
    width: int
    rows: int
    cols: int
    first_tile: int  # tiles are numbered through all levels: (level, map, row, column)


class Blocks(NamedTuple):
    """Blocks of all levels: their regions, and their parents: the blocks of the next level that they refine."""

    grids: tuple[Grid, ...]
    starts: Any  # [tiles + 1] int64, first block of each tile, all levels
    regions: Any  # [K] int64, ascending within a tile
    parents: Any  # [K, 4] int64, above left, above right, below left, below right; K: none
    parity: Any  # [K] uint8: 1 in an odd column of tiles, 2 in an odd row, 3 both

    @property
    def levels(self) -> list[int]:
        """First block of each level, then the number of blocks."""
        return [*(int(self.starts[grid.first_tile]) for grid in self.grids), len(self.regions)]

    @property
    def tiles(self) -> Any:
        """The tile of each block, [K]."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))


def max_spacing(cutoff: float) -> float:
    """Return the largest spacing of nodes for a Gaussian, in units of its smaller standard deviation; 0: no grid."""
    return min(_SPACING * float(cutoff**0.25), _MAX_SPACING)


def grids_of(size: tuple[int, int], maps: int) -> tuple[Grid, ...]:
    """Return the grids of images of a size, level 0 first."""
    height, width = size
    grids = [Grid(height, width, -(-height // TILE), -(-width // TILE), 0)]
    while max(height, width) > _COARSEST_SIDE:
        last = grids[-1]
        # level 1 needs two nodes after the last pixel, at n - 1/2; coarser levels, one after the last node, at n - 2
        is_finest = len(grids) == 1
        height, width = ((n - 1) // 2 + 4 if is_finest else (n - 2) // 2 + 3 for n in (height, width))
        first_tile = last.first_tile + maps * last.rows * last.cols
        grids.append(Grid(height, width, -(-height // TILE), -(-width // TILE), first_tile))
    return tuple(grids)


def make_blocks(starts: Any, regions: Any, num_regions: int, shape: tuple[int, ...]) -> Blocks:
    """Return the blocks of all levels from starts and regions of the tiles of a `MapTable`, shape (maps, H, W)."""
    from .blocks import refine  # loads numba

    maps, *size = shape
    grids = grids_of((size[0], size[1]), maps)
    return Blocks(grids, *refine(starts.astype(np.int64), regions.astype(np.int64), num_regions, maps, np.array(grids)))


class Coarsened(NamedTuple):
    """Gaussians of levels 1 and above in the coordinates of their levels: float64, lengths in nodes."""

    level: Tensor  # [N] int64
    means: Tensor  # [N, 2]
    cholesky: Tensor  # [N, 3]
    factor: Tensor  # [N], multiplies the colours


def choose_levels(cholesky: Tensor, spacing: float, levels: int) -> Tensor:
    """Return the coarsest of the `levels` whose nodes are close enough for each Gaussian, (N,), from float64 factors.

    Nodes h pixels apart are close enough if (h / s1)^4 + (h / s2)^4 <= spacing^4; s1 and s2 are the standard deviations
    along the axes of the ellipse, in pixels.
    """
    l11, l21, l22 = cholesky.unbind(-1)
    # sum and product of the variances along the axes
    total, product = l11 * l11 + l21 * l21 + l22 * l22, l11 * l22 * l11 * l22
    bound = spacing**4 * product * product / (total * total - 2 * product)  # of h^4
    powers = torch.tensor([16.0**n for n in range(1, levels)], dtype=bound.dtype, device=bound.device)
    return torch.searchsorted(powers, bound, right=True)


def coarsen(level: Tensor, means: Tensor, cholesky: Tensor) -> Coarsened:
    """Convert float64 Gaussians from pixels to the coordinates of their levels, which are 1 or more."""
    h = (1 << level).double()[:, None]
    l11, l21, l22 = cholesky.unbind(-1)
    variance = h[:, 0] ** 2 / 3
    square = l11 * l11 - variance
    c11 = square.sqrt()
    c22 = (l22 * l22 - variance * (1 + l21 * l21 / square)).sqrt()
    factors = torch.stack([c11, l11 * l21 / c11, c22], -1) / h
    return Coarsened(level, means / h + 1.5, factors, l11 * l22 / (c11 * c22))
