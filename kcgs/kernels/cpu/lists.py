"""The lists of the CPU kernel: the table of Gaussians, and the Gaussians that touch each block of pixels or nodes."""

from __future__ import annotations

import math

import numpy as np

from kcgs.compiled.program import inline, inner
from kcgs.compiled.tasks import END_ROW, FIRST_ROW, first_task, next_task

from ..grid_columns import FIRST_TILE, NODE_COLS, NODE_ROWS, TILE_COLS, TILE_ROWS
from ..whitened import LEAST_SCALE, MEAN_LIMIT, SCALE, SCALE_LIMITS
from .ellipse import block_rows, clamp_coefficient, row_halves, set_shape, tile_rows
from .layout import (
    CHANGE,
    COLOR_FACTOR,
    END_HALF,
    FIRST,
    FIRST_HALF,
    GAUSSIAN,
    INVERSE_L11,
    L11,
    L21,
    L22,
    LAST,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    PEAK,
    RUN,
    SIGMA_Y,
    SLOPE1_X,
    SLOPE2_X,
    SLOPE2_Y,
    TERMS,
    program,
)
from .simd import HALVES, SIDE

_LOG_4 = math.log(4.0)
# |z| at which a weight is 2^-126, the least normal number, and a little less
_NORMAL_RADIUS = 13.1


@program.entry
def arrange(batch, rows, cols):
    """Return whether all values are finite and within the limits of whitened.py, and if so the `order` of Lists.

    Args:
        batch: Batch.
        rows: rows of tiles per image.
        cols: columns of tiles per image.
    """
    means, per_image = batch.means, max(len(batch.means) // batch.num_images, 1)
    order = np.empty(len(means), np.int64)
    if not _in_range(means, batch.cholesky, batch.colors):
        return False, order
    tiles, start = np.empty(len(means), np.int64), np.zeros(batch.num_images * (rows + 2) * (cols + 2) + 1, np.int64)
    for n in range(len(means)):
        row = min(max(math.floor(means[n, 1] / SIDE) + 1, 0), rows + 1)
        col = min(max(math.floor(means[n, 0] / SIDE) + 1, 0), cols + 1)
        tiles[n] = (n // per_image * (rows + 2) + row) * (cols + 2) + col
        start[tiles[n] + 1] += 1
    for tile in range(len(start) - 1):
        start[tile + 1] += start[tile]
    for n in range(len(means)):
        order[start[tiles[n]]] = n
        start[tiles[n]] += 1
    return True, order


@inner
def _in_range(means, cholesky, colors):
    least, largest = LEAST_SCALE, SCALE_LIMITS[1]
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
def measure(batch, table, radius, spacing, order, gaussians, colors, spans, counts, tasks, counters):
    """Fill gaussians and colors of Lists, and for each Gaussian the rows and the number of blocks that it may touch.

    Args:
        batch: Batch.
        table: TileTable.
        radius: the largest |z| of a weight.
        spacing: largest spacing of nodes, in standard deviations, see coarse_grids.
        order: see Lists.
        gaussians: see there.
        colors: see there.
        spans: (N, 2) int32, first row and last + 1.
        counts: (N,) int64, upper bounds of the number of blocks.
        tasks: ranges of Gaussians, see `tasks.py`.
        counters: see there.
    """
    grids, channels = table.grids, batch.colors.shape[1]
    k = first_task(tasks, counters)
    while k >= 0:
        for i in range(tasks[k, FIRST_ROW], tasks[k, END_ROW]):
            g, n = gaussians[i], order[i]
            _fill(g, batch.means[n], batch.cholesky[n], len(grids), spacing)
            level = int(g[LEVEL])
            for c in range(channels):
                colors[i * channels + c] = batch.colors[n, c] * g[COLOR_FACTOR]
            first, end, count = 0, 0, 0
            if len(batch.regions) == 0 or batch.regions[n] >= 0:
                height, width = grids[level, NODE_ROWS], grids[level, NODE_COLS]
                first, end = tile_rows(g, height, width, radius)
                for row in range(first, end):
                    left, right = row_halves(g, row, height, width, radius)
                    count += (right + HALVES - 1) // HALVES - left // HALVES
            spans[i, 0], spans[i, 1], counts[i] = first, end, count
        k = next_task(tasks, counters, k)


@program.entry
def list_pairs(batch, radius, spans, blocks, histogram, lists, tasks, counters):
    """Fill start, pairs, shapes, num_terms and live of Lists.

    Args:
        batch: Batch.
        radius: the largest |z| of a weight.
        spans: as `measure` fills them.
        blocks: (P, 5) int32, room for the block, rows and halves of each pair, by Gaussian.
        histogram: (T, copies * K) int32, room for the number of pairs of each block, per range of Gaussians.
        lists: Lists; its first_terms are the cumulative sums of `counts`.
        tasks: ranges of Gaussians, then the sum over all, then the ranges once more; see `tasks.py`.
        counters: see there.
    """
    parts = len(histogram)
    k = first_task(tasks, counters)
    while k >= 0:
        if k < parts:
            _find_blocks(batch, radius, spans, blocks, histogram[k], lists, tasks[k, FIRST_ROW], tasks[k, END_ROW])
        elif k == parts:
            _sum_histogram(histogram, lists)
        else:
            _place_pairs(radius, blocks, histogram[k - parts - 1], lists, tasks[k, FIRST_ROW], tasks[k, END_ROW])
        k = next_task(tasks, counters, k)


@inner
def _find_blocks(batch, radius, spans, blocks, histogram, lists, begin, end):
    table, per_image = lists.table, max(len(lists.order) // batch.num_images, 1)
    grids = table.grids
    num_regions, tile_start, block_regions = table.num_regions, table.tile_start, table.regions
    histogram[:] = 0
    for i in range(begin, end):
        g, n, place = lists.gaussians[i], lists.order[i], lists.first_terms[i]
        image, region = n // per_image, batch.regions[n] if len(batch.regions) > 0 else 0
        level = int(g[LEVEL])
        height, width, cols = grids[level, NODE_ROWS], grids[level, NODE_COLS], grids[level, TILE_COLS]
        tile, head = first_tile(table, level, image, 0), first_head(table, image)
        for row in range(spans[i, 0], spans[i, 1]):
            left, right = row_halves(g, row, height, width, radius)
            for col in range(left // HALVES, (right + HALVES - 1) // HALVES):
                block = find_block(num_regions, tile_start, block_regions, tile + row * cols + col, region)
                if block < 0:
                    continue
                first, last = block_rows(g, row, col, height, width, radius)
                if first < last:
                    blocks[place, 0], blocks[place, 1], blocks[place, 2] = head + block, first, last
                    blocks[place, 3], blocks[place, 4] = max(left - col * HALVES, 0), min(right - col * HALVES, HALVES)
                    set_shape(g, row, col, first, lists.shapes[place])
                    histogram[head + block] += 1
                    place += 1
        lists.num_terms[i] = place - lists.first_terms[i]


@inner
def _sum_histogram(histogram, lists):
    """Turn numbers of pairs into the places of their first pairs, set `start`, and mark live blocks of nodes."""
    table, start, live = lists.table, lists.start, lists.live
    # the inner loop follows a row of the histogram, so that it is vectorised
    start[:] = 0
    for part in range(len(histogram)):
        for head in range(len(start) - 1):
            start[head + 1] += histogram[part, head]
    for head in range(len(start) - 1):
        start[head + 1] += start[head]
    places = start.copy()
    for part in range(len(histogram)):
        for head in range(len(start) - 1):
            count = histogram[part, head]
            histogram[part, head] = places[head]
            places[head] += count
    blocks, first = len(table.parents), len(table.mask_rows)
    for copy in range((len(start) - 1) // blocks):
        base = copy * (blocks - first + 1) - first
        live[base + blocks] = False
        for block in range(blocks - 1, first - 1, -1):
            head = copy * blocks + block
            is_live = start[head] < start[head + 1]
            for k in range(4):  # parents come after their blocks
                is_live |= live[base + table.parents[block, k]]
            live[base + block] = is_live


@inner
def _place_pairs(radius, blocks, places, lists, begin, end):
    for i in range(begin, end):
        first = lists.first_terms[i]
        run = min(max(math.floor((_NORMAL_RADIUS - radius) * lists.gaussians[i, L22]), 1), SIDE)
        for k in range(first, first + lists.num_terms[i]):
            pair = lists.pairs[places[blocks[k, 0]]]
            places[blocks[k, 0]] += 1
            pair[GAUSSIAN], pair[TERMS], pair[FIRST], pair[LAST] = i, k, blocks[k, 1], blocks[k, 2]
            pair[RUN], pair[FIRST_HALF], pair[END_HALF] = run, blocks[k, 3], blocks[k, 4]


@inline
def _fill(g, mean, cholesky, levels, spacing):
    """Fill in the columns of a Gaussian."""
    g[MEAN_X], g[MEAN_Y] = mean[0], mean[1]
    g[L11], g[L21], g[L22] = cholesky[0], cholesky[1], cholesky[2]
    _coarsen(g, spacing, levels)
    g[SIGMA_Y] = math.sqrt(g[L21] * g[L21] + g[L22] * g[L22])
    g[INVERSE_L11] = 1.0 / g[L11]
    g[PEAK] = g[L21] / g[SIGMA_Y]
    g[SLOPE1_X] = clamp_coefficient(SCALE * g[INVERSE_L11])
    g[SLOPE2_Y] = SCALE / g[L22]
    g[SLOPE2_X] = clamp_coefficient(-g[SLOPE2_Y] * g[L21] * g[INVERSE_L11])
    g[SLOPE2_Y] = clamp_coefficient(g[SLOPE2_Y])
    g[CHANGE] = math.expm1(-g[SLOPE2_Y] * g[SLOPE2_Y] * _LOG_4)


@inline
def _coarsen(g, spacing, levels):
    """Move a Gaussian to its level.

    It repeats coarse_grids.choose_levels and coarsen in scalars, since numba compiles no torch; test_coarse_grids
    compares them.
    """
    # sum and product of the variances along the axes of the ellipse
    total, product = g[L11] * g[L11] + g[L21] * g[L21] + g[L22] * g[L22], g[L11] * g[L22] * g[L11] * g[L22]
    spacing *= spacing
    bound = spacing * spacing * product * product / (total * total - 2 * product)  # of h^4
    level, power = 0, 16.0
    while level + 1 < levels and power <= bound:
        level, power = level + 1, power * 16.0
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


@inline
def find_block(num_regions, tile_start, regions, tile, region):
    """Return the position of a region's block in a tile, or -1; it takes arrays: passing a TileTable is slow."""
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
def first_tile(table, level, image, row):
    """Return the number of the first tile of a row of tiles."""
    grid = table.grids[level]
    return grid[FIRST_TILE] + (image % table.num_maps * grid[TILE_ROWS] + row) * grid[TILE_COLS]


@inner
def first_head(table, image):
    """Return the place in Lists.start of an image's first block; images that share a map have a copy each."""
    return image * len(table.regions) if table.num_maps == 1 else 0


@inner
def first_node_block(table, image):
    """Return the number of an image's first block of nodes; images that share a map have a copy each."""
    return image * (len(table.regions) - len(table.mask_rows) + 1) if table.num_maps == 1 else 0
