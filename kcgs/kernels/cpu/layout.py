"""Arrays that the loops of the CPU kernel read, and the columns of these arrays; `program` holds the loops."""

from __future__ import annotations

from typing import Any, NamedTuple

from kcgs.compiled.program import Program

program = Program("CPU kernel")

# columns of Lists.gaussians; lengths in nodes of the Gaussian's level, which at level 0 are pixels
MEAN_X = 0
MEAN_Y = 1
L11 = 2
L21 = 3
L22 = 4
SIGMA_Y = 5  # standard deviation along y
INVERSE_L11 = 6
PEAK = 7  # z1 at the largest y of the ellipse |z| = 1
SLOPE1_X = 8  # SCALE * z1 per node along x
SLOPE2_X = 9  # SCALE * z2 per node along x
SLOPE2_Y = 10  # SCALE * z2 per node along y
LEVEL = 11  # of the coarse grid; 0: the pixels
COLOR_FACTOR = 12  # multiplies its colours, since a spline widens it
CHANGE = 13  # c - 1, where the growth of a weight from row to row changes by the factor c, see rows.py
COLUMNS = 14

# columns of Lists.pairs
GAUSSIAN = 0
TERMS = 1  # row of its shape and of its sums
FIRST = 2  # row of the block
LAST = 3  # last row + 1
RUN = 4  # rows from an exponential to the next
FIRST_HALF = 5  # first half of the columns that the ellipse touches
END_HALF = 6  # last half + 1
PAIR_COLUMNS = 7
PREFETCH_DISTANCE = 4  # pairs ahead whose shape is prefetched: the shapes of a block lie far apart
SHAPE_COLUMNS = 7


class TileTable(NamedTuple):
    """The regions of each tile and block, from a label map; without a map, one region covers everything."""

    num_regions: int
    num_maps: int  # 1, or as many as images
    grids: Any  # [levels, 5] int64, see `coarse_grids.Grid`
    regions: Any  # [K] int64, region of each block, in the order of tiles
    tile_start: Any  # [tiles + 1] int64 into blocks, all levels
    parents: Any  # [K, 4] int64, blocks of the next level from which a block is refined; K: none
    parity: Any  # [K] uint8: 1 in an odd column of tiles, 2 in an odd row, 3 both
    mask_rows: Any  # [blocks of pixels] int64, row of masks; -1: the region is alone in its tile
    masks: Any  # [P * 256] float32, membership of the pixels of a tile


class Batch(NamedTuple):
    """Gaussians of a batch of images, in the caller's order."""

    num_images: int
    means: Any  # [N, 2] float32
    cholesky: Any  # [N, 3] float32
    colors: Any  # [N, C] float32
    regions: Any  # [N] int64, -1: none; empty: one region holds all


class Lists(NamedTuple):
    """The Gaussians of each block: tiles of pixels, and blocks of nodes.

    Gaussians are ordered by image, row and column of tiles: neighbours in the image are neighbours in memory.
    """

    order: Any  # [N] int64, from this order to the caller's
    gaussians: Any  # [N, COLUMNS] float64
    colors: Any  # [N * C] float32, times COLOR_FACTOR
    start: Any  # [copies * K + 1] int64 into pairs; images that share a map have a copy of its blocks each
    pairs: Any  # [P, 7] int32, by block, then by Gaussian
    shapes: Any  # [P, 7] float32, the Gaussian in the block, see ellipse.set_shape; in the order of sums
    first_terms: Any  # [N + 1] int64, place of each Gaussian's first sums
    num_terms: Any  # [N] int32, blocks that each Gaussian touches
    table: TileTable
    live: Any  # [copies * (blocks of nodes + 1)] bool; False: the block is all zero, as the last of each copy is
    cutoff: Any  # float32; smaller weights are zero
