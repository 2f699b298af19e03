"""The lists of the CPU kernel: the table of Gaussians, which rows of tiles each touches, and which blocks of nodes."""

from __future__ import annotations

import math

import numpy as np

from ..compiled import inner
from ..whitened import MEAN_LIMIT, SCALE_LIMITS
from .ellipse import bounded, bounding_columns, count_vectors, tile_columns, tile_rows
from .layout import (
    COLOR_FACTOR,
    COLUMNS,
    END,
    FIRST,
    FIRST_ROW,
    FIRST_TILE,
    GAUSSIAN,
    INVERSE_L11,
    L11,
    L21,
    L22,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    NODE_COLS,
    NODE_ROWS,
    PADDING,
    PEAK,
    SCALE,
    SHEAR,
    SIGMA_Y,
    SLOPE1_X,
    SLOPE2_X,
    SLOPE2_Y,
    TILE_COLS,
    TILE_ROWS,
    program,
)
from .simd import SIDE


@program.entry
def in_range(means, cholesky, colors):  # type: ignore[no-untyped-def]
    """True where means, factors and colours are finite, and within the limits of whitened.py."""
    least, largest = SCALE_LIMITS[0] * (1 - 1e-6), SCALE_LIMITS[1]
    is_valid = True
    for i in range(len(means)):  # written so that NaN fails
        is_valid &= abs(means[i, 0]) <= MEAN_LIMIT and abs(means[i, 1]) <= MEAN_LIMIT
        is_valid &= (
            least <= cholesky[i, 0] <= largest and abs(cholesky[i, 1]) <= largest and least <= cholesky[i, 2] <= largest
        )
        for c in range(colors.shape[1]):
            is_valid &= abs(colors[i, c]) < math.inf
    return is_valid


@program.entry
def list_tiles(batch, table, radius, spacing):  # type: ignore[no-untyped-def]
    """Return the gaussians, start, entries and live of Lists for a Batch and a Table; scale the Batch's colours.

    `radius` is the largest |z| of a weight, `spacing` that of nodes in standard deviations, see coarse_grids.
    """
    count, grids, channels = len(batch.order), table.grids, batch.colors.shape[1]
    levels, images = len(grids), batch.num_images
    gaussians = np.empty((count, COLUMNS))
    start = np.zeros((grids[levels - 1, FIRST_ROW] + grids[levels - 1, TILE_ROWS]) * images + 1, np.int64)
    span = np.empty((count, 2), np.int32)  # rows of tiles, first and last + 1
    for i in range(count):
        g = gaussians[i]
        _fill(g, batch.means[batch.order[i]], batch.cholesky[batch.order[i]], levels, radius, spacing)
        level = int(g[LEVEL])
        if level > 0:
            for c in range(channels):
                batch.colors[i, c] *= g[COLOR_FACTOR]
        first, end = 0, 0
        if batch.regions[i] >= 0:
            first, end = tile_rows(g, grids[level, NODE_ROWS], grids[level, NODE_COLS], radius)
        base = grids[level, FIRST_ROW] * images + batch.images[i] * grids[level, TILE_ROWS]
        span[i, 0], span[i, 1] = base + first, base + end
        for row in range(base + first, base + end):
            start[row + 1] += 1
    for r in range(len(start) - 1):
        start[r + 1] += start[r]
    entries, live = _list_entries(batch, table, gaussians, span, start, radius)
    return gaussians, start, entries, live


@inner
def _fill(g, mean, cholesky, levels, radius, spacing):  # type: ignore[no-untyped-def]
    """Fill in the columns of a Gaussian."""
    g[MEAN_X], g[MEAN_Y] = mean[0], mean[1]
    g[L11], g[L21], g[L22] = cholesky[0], cholesky[1], cholesky[2]
    _coarsen(g, spacing, levels)
    g[SIGMA_Y] = math.sqrt(g[L21] * g[L21] + g[L22] * g[L22])
    g[INVERSE_L11] = 1.0 / g[L11]
    g[PEAK] = radius * g[L21] / g[SIGMA_Y]
    g[SHEAR] = g[L11] * g[L21] / (g[SIGMA_Y] * g[SIGMA_Y])
    g[SLOPE1_X] = bounded(SCALE * g[INVERSE_L11])
    g[SLOPE2_Y] = SCALE / g[L22]
    g[SLOPE2_X] = bounded(-g[SLOPE2_Y] * g[L21] * g[INVERSE_L11])
    g[SLOPE2_Y] = bounded(g[SLOPE2_Y])


@inner
def _coarsen(g, spacing, levels):  # type: ignore[no-untyped-def]
    """Move a Gaussian to its level.

    coarse_grids.choose_levels and coarsen in scalars, since numba compiles no torch; test_backends_agree compares them.
    """
    # of the variances along the axes of the ellipse: their sum, and their product
    total, product = g[L11] * g[L11] + g[L21] * g[L21] + g[L22] * g[L22], g[L11] * g[L22] * g[L11] * g[L22]
    bound = spacing**4 * product * product / (total * total - 2 * product)  # of h^4
    level = 0
    while level + 1 < levels and 16.0 ** (level + 1) <= bound:
        level += 1
    g[LEVEL], g[COLOR_FACTOR] = level, 1.0
    if level == 0:
        return
    h = float(1 << level)
    l11, l21, l22, variance = g[L11], g[L21], g[L22], h * h / 3
    square = l11 * l11 - variance
    g[L11] = math.sqrt(square)
    g[L21] = l11 * l21 / g[L11]
    g[L22] = math.sqrt(l22 * l22 - variance * (1 + l21 * l21 / square))
    g[COLOR_FACTOR] = l11 * l22 / (g[L11] * g[L22])
    g[L11], g[L21], g[L22] = g[L11] / h, g[L21] / h, g[L22] / h
    g[MEAN_X], g[MEAN_Y] = g[MEAN_X] / h + 1.5, g[MEAN_Y] / h + 1.5


@inner
def _list_entries(batch, table, gaussians, span, start, radius):  # type: ignore[no-untyped-def]
    end, entries = start[:-1].copy(), np.empty((start[-1], 3), np.int32)
    grids, mask_rows, maps, owner = table.grids, table.mask_rows, table.num_maps, table.owner
    num_regions, tile_start, block_regions = table.num_regions, table.tile_start, table.regions
    nodes = len(block_regions) - len(mask_rows)
    live = np.zeros((batch.num_images if maps == 1 else 1) * (nodes + 1), np.bool_)
    for i in range(len(gaussians)):
        g, image, region = gaussians[i], batch.images[i], batch.regions[i]
        level = int(g[LEVEL])
        height, width, cols = grids[level, NODE_ROWS], grids[level, NODE_COLS], grids[level, TILE_COLS]
        base = grids[level, FIRST_ROW] * batch.num_images + image * grids[level, TILE_ROWS]
        tile = grids[level, FIRST_TILE] + (image % maps * grids[level, TILE_ROWS] - base) * cols
        vectors = count_vectors(g, radius)
        first_block = (image * (nodes + 1) if maps == 1 else 0) - len(mask_rows)
        if level == 0 and SIDE * vectors <= PADDING:
            first, last = bounding_columns(g, width, radius)
            is_alone = True
            for k in range(tile + span[i, 0] * cols, tile + span[i, 1] * cols, cols):
                for col in range(first, last):
                    if owner[k + col] != region:
                        is_alone = False
            if is_alone:
                for row in range(span[i, 0], span[i, 1]):
                    e = end[row]
                    end[row] += 1
                    entries[e, GAUSSIAN], entries[e, FIRST], entries[e, END] = i, -1, vectors
                continue
        for row in range(span[i, 0], span[i, 1]):
            e = end[row]
            end[row] += 1
            first, last = tile_columns(g, row - base, height, width, radius)
            entries[e, GAUSSIAN], entries[e, FIRST], entries[e, END] = i, first, last
            if level > 0:
                for k in range(tile + row * cols + first, tile + row * cols + last):
                    block = find_block(num_regions, tile_start, block_regions, k, region)
                    if block >= 0:
                        live[first_block + block] = True
    _spread(live, table.parents, len(mask_rows))
    return entries, live


@inner
def _spread(live, parents, first):  # type: ignore[no-untyped-def]
    """Mark blocks as live where one of their parents is; these come after them."""
    blocks = len(parents)
    for base in range(-first, len(live) - first, blocks - first + 1):
        for block in range(blocks - 1, first - 1, -1):
            for k in range(4):
                if live[base + parents[block, k]]:
                    live[base + block] = True


@inner
def find_block(num_regions, tile_start, regions, tile, region):  # type: ignore[no-untyped-def]
    """Return the position of a region's block in a tile, or -1; takes arrays, since to pass on a Table is slow."""
    if num_regions == 1:
        return tile
    low, high = tile_start[tile], tile_start[tile + 1]
    end = high
    while low < high:
        middle = (low + high) // 2
        if regions[middle] < region:
            low = middle + 1
        else:
            high = middle
    return low if low < end and regions[low] == region else -1


@inner
def first_tile(table, level, image, row):  # type: ignore[no-untyped-def]
    """Return the number of the first tile of a row of tiles."""
    grid = table.grids[level]
    return grid[FIRST_TILE] + (image % table.num_maps * grid[TILE_ROWS] + row) * grid[TILE_COLS]


@inner
def first_node_block(table, image):  # type: ignore[no-untyped-def]
    """Return the number of an image's first block of nodes; images that share a map have a copy each."""
    return image * (len(table.regions) - len(table.mask_rows) + 1) if table.num_maps == 1 else 0
