"""The CPU kernel's lists: the Gaussians as the loops read them, and which tiles and blocks each touches.

Gaussians wider than the nodes of a coarser grid move there: see ..coarse_grids.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from ..compiled import Program, inner
from ..whitened import MEAN_LIMIT, SCALE_LIMITS, Z_LIMIT
from .simd import SIDE

# z * SCALE, squared, is an exponent of 2
SCALE = math.sqrt(0.5 / math.log(2.0))
# pixels by which geometry in float64 is kept on the safe side of the weights in float32
MARGIN = 1e-3

# columns of the table of Gaussians, in nodes of its level: mean, factor, standard deviation along y, 1 / l11, where the
# ellipse is highest (in standard deviations along x), the slopes of z1 along x and of z2 along x and y, times SCALE;
# level, the factor of its colours, and how far the middle of a row is from that of the next
MX, MY, L11, L21, L22, HEIGHT, INVERSE, PEAK, RISE1, RISE2, RISE3, LEVEL, FACTOR, SHEAR = range(14)
COLUMNS = 14
# pixels on either side of a row of tiles, for vectors that begin before it or end behind it
PADDING = 4 * SIDE
# columns of the grids
ROWS_OF_NODES, COLS_OF_NODES, ROWS, COLS, FIRST_TILE, FIRST_ROW = range(6)

program = Program("CPU kernel", __file__, "../whitened.py", "loops.py", "rows.py", "simd.py", "spline.py")


class Table(NamedTuple):
    """What a label map gives, or one region everywhere: which regions are in which tiles and blocks."""

    num_regions: int
    maps: int  # label maps, 1 or as many as images
    grids: Any  # [levels, 6] int64
    regions: Any  # [K] int64 region of each block, in the order of tiles
    tile_start: Any  # [tiles + 1] int64 into blocks, all levels
    parents: Any  # [K, 4] int64, K: none
    odd: Any  # [K] uint8: 1 in an odd column of tiles, 2 in an odd row, 3 both
    owner: Any  # [tiles of pixels] int64 the region that has all of a tile; -1: none
    mask: Any  # [first] int64 row of masks, -1: alone in its tile
    masks: Any  # [P * 256] float32


class Lists(NamedTuple):
    """Everything the loops read, as arrays."""

    gaussians: Any  # [N, COLUMNS] float64, sorted
    colors: Any  # [N * C] float32
    regions: Any  # [N] int64
    start: Any  # [rows of tiles + 1] int64 into entries
    entries: Any  # [E, 3] int32: Gaussian, first tile, last tile + 1; or Gaussian, -1, vectors of each row
    table: Table
    live: Any  # [copies * (blocks of nodes + 1)] bool: not all zero; the last block of a copy never is
    radius: float  # largest |z|
    lowest: Any  # float32, least exponent of 2


@inner
def _bounded(value):  # type: ignore[no-untyped-def]
    return min(max(value, -Z_LIMIT), Z_LIMIT)


@inner
def _highest(along, across, peak, low, high, radius):  # type: ignore[no-untyped-def]
    """Return the largest along * u + across * sqrt(radius^2 - u^2), which peaks at u = peak, over [low, high]."""
    u = min(max(peak, low), high)
    return along * u + across * math.sqrt(max(radius * radius - u * u, 0.0))


@inner
def _row_range(g, height, width, radius):  # type: ignore[no-untyped-def]
    reach, spread = g[HEIGHT] * radius + MARGIN, g[L11] * radius + MARGIN
    first = math.ceil(max(g[MY] - reach - 0.5, 0.0))
    last = math.floor(min(g[MY] + reach - 0.5, height - 1.0))
    if g[MX] + spread < 0.5 or g[MX] - spread > width - 0.5 or first > last:
        return 0, 0
    return first // SIDE, last // SIDE + 1


@inner
def _tile_range(g, row, height, width, radius):  # type: ignore[no-untyped-def]
    # the ellipse's columns within the row of tiles, by the factor of (y, x)
    h = g[HEIGHT]
    top = max((row * SIDE + 0.5 - MARGIN - g[MY]) / h, -radius)
    bottom = min((min(row * SIDE + SIDE, height) - 0.5 + MARGIN - g[MY]) / h, radius)
    along, across = g[L11] * g[L21] / h, g[L11] * g[L22] / h
    right = g[MX] + _highest(along, across, g[PEAK], top, bottom, radius) + MARGIN
    left = g[MX] - _highest(along, across, g[PEAK], -bottom, -top, radius) - MARGIN
    first = math.ceil(max(left - 0.5, 0.0))
    last = math.floor(min(right - 0.5, width - 1.0))
    return (first // SIDE, last // SIDE + 1) if first <= last else (0, 0)


@inner
def enter_tile(g, row, col, height, width, radius, coefficients):  # type: ignore[no-untyped-def]
    """Set the coefficients of z * SCALE about the tile's middle; return the rows, first and last + 1, to visit."""
    left = max((col * SIDE + 0.5 - MARGIN - g[MX]) * g[INVERSE], -radius)
    right = min((min(col * SIDE + SIDE, width) - 0.5 + MARGIN - g[MX]) * g[INVERSE], radius)
    if left > right:
        return 0, 0
    base = row * SIDE
    bottom = g[MY] + _highest(g[L21], g[L22], g[PEAK], left, right, radius) + MARGIN
    top = g[MY] - _highest(g[L21], g[L22], g[PEAK], -right, -left, radius) - MARGIN
    first = math.ceil(max(top - 0.5, float(base)))
    last = math.floor(min(bottom - 0.5, min(base + SIDE, height) - 1.0))
    x, y = col * SIDE + SIDE / 2 - g[MX], base + SIDE / 2 - g[MY]
    coefficients[0] = _bounded(g[RISE1] * x)
    coefficients[1] = g[RISE1]
    coefficients[2] = _bounded(g[RISE3] * y + g[RISE2] * x)
    coefficients[3] = g[RISE2]
    coefficients[4] = g[RISE3]
    return first - base, last + 1 - base


@inner
def enter_rows(g, row, height, width, radius, vectors, shape):  # type: ignore[no-untyped-def]
    """Set the shape of a narrow Gaussian's rows (see rows); return the rows, first and last + 1, to visit."""
    reach, base = g[HEIGHT] * radius + MARGIN, row * SIDE
    first = max(math.ceil(g[MY] - reach - 0.5), base)
    last = min(math.floor(g[MY] + reach - 0.5), min(base + SIDE, height) - 1)
    shape[1] = g[SHEAR]
    shape[3] = base + 0.5 - g[MY]
    shape[0] = g[MX] + shape[1] * shape[3] - (SIDE // 2 * vectors - 0.5)
    shape[2], shape[4], shape[5], shape[6] = g[MX], g[RISE1], g[RISE2], g[RISE3]
    shape[7], shape[8] = -PADDING, width
    return first - base, last + 1 - base


@inner
def _count_vectors(g, radius):  # type: ignore[no-untyped-def]
    """Vectors that hold the ellipse in every row, around its middle there."""
    return math.ceil(min((g[L11] * g[L22] / g[HEIGHT] * radius + 1.0) / (SIDE // 2), 99.0))


@inner
def find_block(num_regions, tile_start, regions, tile, region):  # type: ignore[no-untyped-def]
    """Position of a region's block in a tile; -1: it is not there. Takes arrays: to hand on a tuple is slow."""
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
    """First tile of a row of tiles."""
    grid = table.grids[level]
    return grid[FIRST_TILE] + (image % table.maps * grid[ROWS] + row) * grid[COLS]


@inner
def copy_of(table, image):  # type: ignore[no-untyped-def]
    """Where the blocks of nodes of an image start: images that share a map have each their own copy."""
    return image * (len(table.regions) - len(table.mask) + 1) if table.maps == 1 else 0


@inner
def _coarsen(g, spacing, levels):  # type: ignore[no-untyped-def]
    """Move a Gaussian to the coarsest level whose nodes h are close enough: (h / s1)^4 + (h / s2)^4 <= spacing^4."""
    # of the variances along the axes of the ellipse: their sum, and their product
    total, product = g[L11] * g[L11] + g[L21] * g[L21] + g[L22] * g[L22], g[L11] * g[L22] * g[L11] * g[L22]
    most = spacing**4 * product * product / (total * total - 2 * product)
    level = 0
    while level + 1 < levels and 16.0 ** (level + 1) <= most:
        level += 1
    g[LEVEL], g[FACTOR] = level, 1.0
    if level == 0:
        return
    h = float(1 << level)
    l11, l21, l22, variance = g[L11], g[L21], g[L22], h * h / 3
    rest = l11 * l11 - variance
    g[L11] = math.sqrt(rest)
    g[L21] = l11 * l21 / g[L11]
    g[L22] = math.sqrt(l22 * l22 - variance * (1 + l21 * l21 / rest))
    g[FACTOR] = l11 * l22 / (g[L11] * g[L22])
    g[L11], g[L21], g[L22] = g[L11] / h, g[L21] / h, g[L22] / h
    g[MX], g[MY] = g[MX] / h + 1.5, g[MY] / h + 1.5


# in place of a level: the blocks of nodes are refined
REFINEMENT = -1


@functools.lru_cache(maxsize=8)
def order_rows(counts: tuple[int, ...], batch: int) -> tuple[Any, list[int]]:
    """Rows of tiles in the order of the backward, the forward's is the reverse: number, level, image, row in its grid.

    First the rows of pixels by their number modulo 4, first 0 and 2, then 1, then 3: those of a section share no blocks
    of nodes. Then the refinement, then the rows of nodes. Also returns where the five sections start, and the end.

    Args:
        counts: rows of tiles of each level.
        batch: images.
    """
    by_level = [
        np.column_stack([np.arange(batch * count) + batch * sum(counts[:level]), np.full(batch * count, level),
                         np.repeat(np.arange(batch), count), np.tile(np.arange(count), batch)])
        for level, count in enumerate(counts)
    ]  # fmt: skip
    turn = by_level[0][:, 3] % 4
    sections = [by_level[0][chosen] for chosen in (turn % 2 == 0, turn == 1, turn == 3)]
    nodes = np.concatenate([np.empty((0, 4), np.int64), *by_level[1:]])
    sections += [np.array([[0, REFINEMENT, 0, 0]]), nodes]
    return np.concatenate(sections), np.cumsum([0, *map(len, sections)]).tolist()


@program.entry
def in_range(means, factors, colors):  # type: ignore[no-untyped-def]
    """Whether all is finite, and where arithmetic stays so."""
    least, most = SCALE_LIMITS[0] * (1 - 1e-6), SCALE_LIMITS[1]
    fine = True
    for i in range(len(means)):  # written so that NaN fails
        fine &= abs(means[i, 0]) <= MEAN_LIMIT and abs(means[i, 1]) <= MEAN_LIMIT
        fine &= least <= factors[i, 0] <= most and abs(factors[i, 1]) <= most and least <= factors[i, 2] <= most
        for c in range(colors.shape[1]):
            fine &= abs(colors[i, c]) < math.inf
    return fine


@program.entry
def list_tiles(means, factors, colors, order, regions, images, batch, table, radius, spacing):  # type: ignore[no-untyped-def]
    """Make the table of Gaussians, scale their colours, list them by rows of tiles, and tell which blocks are alive."""
    count, grids, channels = len(order), table.grids, colors.shape[1]
    levels = len(grids)
    gaussians = np.empty((count, COLUMNS))
    start = np.zeros((grids[levels - 1, FIRST_ROW] + grids[levels - 1, ROWS]) * batch + 1, np.int64)
    span = np.empty((count, 2), np.int32)
    for i in range(count):
        g, given = gaussians[i], order[i]
        g[MX], g[MY] = means[given, 0], means[given, 1]
        g[L11], g[L21], g[L22] = factors[given, 0], factors[given, 1], factors[given, 2]
        _coarsen(g, spacing, levels)
        g[HEIGHT] = math.sqrt(g[L21] * g[L21] + g[L22] * g[L22])
        g[INVERSE] = 1.0 / g[L11]
        g[PEAK] = radius * g[L21] / g[HEIGHT]
        g[SHEAR] = g[L11] * g[L21] / (g[HEIGHT] * g[HEIGHT])
        g[RISE1] = _bounded(SCALE * g[INVERSE])
        g[RISE3] = SCALE / g[L22]
        g[RISE2] = _bounded(-g[RISE3] * g[L21] * g[INVERSE])
        g[RISE3] = _bounded(g[RISE3])
        level = int(g[LEVEL])
        if level > 0:
            for c in range(channels):
                colors[i, c] *= g[FACTOR]
        first, last = 0, 0
        if regions[i] >= 0:
            first, last = _row_range(g, grids[level, ROWS_OF_NODES], grids[level, COLS_OF_NODES], radius)
        at = grids[level, FIRST_ROW] * batch + images[i] * grids[level, ROWS]
        span[i, 0], span[i, 1] = at + first, at + last
        for row in range(at + first, at + last):
            start[row + 1] += 1
    for r in range(len(start) - 1):
        start[r + 1] += start[r]
    entries, live = _list_entries(table, gaussians, regions, images, span, start, batch, radius)
    return gaussians, start, entries, live


@inner
def _list_entries(table, gaussians, regions, images, span, start, batch, radius):  # type: ignore[no-untyped-def]
    end, entries = start[:-1].copy(), np.empty((start[-1], 3), np.int32)
    grids, parents, mask, maps, owner = table.grids, table.parents, table.mask, table.maps, table.owner
    num_regions, tile_start, block_regions = table.num_regions, table.tile_start, table.regions
    nodes = len(block_regions) - len(mask)
    live = np.zeros((batch if maps == 1 else 1) * (nodes + 1), np.bool_)
    for i in range(len(gaussians)):
        g, image, region = gaussians[i], images[i], regions[i]
        level = int(g[LEVEL])
        height, width, cols = grids[level, ROWS_OF_NODES], grids[level, COLS_OF_NODES], grids[level, COLS]
        above = grids[level, FIRST_ROW] * batch + image * grids[level, ROWS]
        tile = grids[level, FIRST_TILE] + (image % maps * grids[level, ROWS] - above) * cols
        vectors = _count_vectors(g, radius)
        base = (image * (nodes + 1) if maps == 1 else 0) - len(mask)
        if level == 0 and SIDE * vectors <= PADDING:
            # of the tiles around it
            spread = g[L11] * radius + MARGIN
            first = max(math.ceil(g[MX] - spread - 0.5), 0) // SIDE
            last = min(math.floor(g[MX] + spread - 0.5), width - 1) // SIDE + 1
            inside = True
            for k in range(tile + span[i, 0] * cols, tile + span[i, 1] * cols, cols):
                for col in range(first, last):
                    if owner[k + col] != region:
                        inside = False
            if inside:
                for row in range(span[i, 0], span[i, 1]):
                    e = end[row]
                    end[row] += 1
                    entries[e, 0], entries[e, 1], entries[e, 2] = i, -1, vectors
                continue
        for row in range(span[i, 0], span[i, 1]):
            e = end[row]
            end[row] += 1
            first, last = _tile_range(g, row - above, height, width, radius)
            entries[e, 0], entries[e, 1], entries[e, 2] = i, first, last
            if level > 0:
                for k in range(tile + row * cols + first, tile + row * cols + last):
                    block = find_block(num_regions, tile_start, block_regions, k, region)
                    if block >= 0:
                        live[base + block] = True
    _spread(live, parents, len(mask))
    return entries, live


@inner
def _spread(live, parents, first):  # type: ignore[no-untyped-def]
    """A block is alive, too, where one that it is refined from is: those come after it."""
    blocks = len(parents)
    for base in range(-first, len(live) - first, blocks - first + 1):
        for block in range(blocks - 1, first - 1, -1):
            for k in range(4):
                if live[base + parents[block, k]]:
                    live[base + block] = True
