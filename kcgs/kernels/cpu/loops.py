"""The loops of the CPU kernel: over rows of tiles, the Gaussians of each, and the tiles that each touches.

A row of tiles belongs to one thread, so the result does not depend on the number of threads. Within a tile only the
rows of pixels that the ellipse crosses are visited.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..compiled import Program, inner
from ..whitened import MEAN_LIMIT, SCALE_LIMITS, Z_LIMIT
from .simd import SIDE, add_rows, copy, gather_rows, sum_columns

# z * SCALE, squared, is an exponent of 2
SCALE = math.sqrt(0.5 / math.log(2.0))
# pixels by which geometry in float64 is kept on the safe side of the weights in float32
MARGIN = 1e-3

# columns of the table of Gaussians: mean, factor, standard deviation along y, 1 / l11, where the ellipse is highest
# (in standard deviations along x), and the slopes of z1 along x and of z2 along x and y, times SCALE
MX, MY, L11, L21, L22, HEIGHT, INVERSE, PEAK, RISE1, RISE2, RISE3 = range(11)
COLUMNS = 11


program = Program("CPU kernel", __name__, __file__, "../whitened.py", "loops.py", "simd.py")


class Lists(NamedTuple):
    """Everything the loops read, as arrays."""

    gaussians: Any  # [N, COLUMNS] float64, sorted
    colors: Any  # [N * C] float32
    regions: Any  # [N] int64
    start: Any  # [rows of tiles + 1] int64 into entries
    entries: Any  # [E, 3] int32: Gaussian, first tile, last tile + 1
    num_regions: int  # 0: no map
    maps: int  # label maps, 1 or as many as images
    keys: Any  # [K] int64, tile * num_regions + region
    tile_start: Any  # [tiles + 1] int64 into keys
    mask: Any  # [K] int64 row of masks, -1: alone in its tile
    masks: Any  # [P * 256] float32
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
def _find_mask(lists, tile, region):  # type: ignore[no-untyped-def]
    """Offset of the region's mask, negative where it is alone in the tile; and whether it is in the tile."""
    key = tile * lists.num_regions + region
    low, high = lists.tile_start[tile], lists.tile_start[tile + 1]
    end = high
    while low < high:
        middle = (low + high) // 2
        if lists.keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    if low == end or lists.keys[low] != key:
        return -1, False
    return lists.mask[low] * SIDE * SIDE, True


@inner
def _enter_tile(g, row, col, height, width, radius, coefficients):  # type: ignore[no-untyped-def]
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
def list_tiles(means, factors, order, regions, images, batch, height, width, radius):  # type: ignore[no-untyped-def]
    """Make the table of Gaussians, the start of each row of tiles in the list, and the list."""
    count, rows = len(order), -(-height // SIDE)
    table = np.empty((count, COLUMNS))
    start = np.zeros(batch * rows + 1, np.int64)
    span = np.zeros((count, 2), np.int64)
    for i in range(count):
        g, given = table[i], order[i]
        g[MX], g[MY] = means[given, 0], means[given, 1]
        g[L11], g[L21], g[L22] = factors[given, 0], factors[given, 1], factors[given, 2]
        g[HEIGHT] = math.hypot(g[L21], g[L22])
        g[INVERSE] = 1.0 / g[L11]
        g[PEAK] = radius * g[L21] / g[HEIGHT]
        g[RISE1] = _bounded(SCALE / g[L11])
        g[RISE2] = _bounded(-SCALE * (g[L21] / g[L11]) / g[L22])
        g[RISE3] = _bounded(SCALE / g[L22])
        if regions[i] >= 0:
            span[i, 0], span[i, 1] = _row_range(g, height, width, radius)
        for row in range(span[i, 0], span[i, 1]):
            start[images[i] * rows + row + 1] += 1
    for r in range(batch * rows):
        start[r + 1] += start[r]
    end = start[:-1].copy()
    entries = np.empty((start[-1], 3), np.int32)
    for i in range(count):
        for row in range(span[i, 0], span[i, 1]):
            e = end[images[i] * rows + row]
            entries[e, 0] = i
            entries[e, 1], entries[e, 2] = _tile_range(table[i], row, height, width, radius)
            end[images[i] * rows + row] += 1
    return table, start, entries


@inner
def _exchange(pixels, image, row, outward):  # type: ignore[no-untyped-def]
    """Copy a row of tiles to its place in an image, or from there."""
    channels, height, width = image.shape[1:]
    rows, cols, last = -(-height // SIDE), width // SIDE, width % SIDE
    b, top = row // rows, row % rows * SIDE
    for r in range(min(SIDE, height - top)):
        for c in range(channels):
            outside, inside = ((b * channels + c) * height + top + r) * width, (r * channels + c) * SIDE
            for _ in range(cols):
                if outward:
                    copy(image, outside, pixels, inside, SIDE)  # type: ignore[call-arg]
                else:
                    copy(pixels, inside, image, outside, SIDE)  # type: ignore[call-arg]
                outside += SIDE
                inside += SIDE * SIDE * channels
            if outward:
                copy(image, outside, pixels, inside, last)  # type: ignore[call-arg]
            else:
                copy(pixels, inside, image, outside, last)  # type: ignore[call-arg]


@program.entry
def render(lists, offset, step, image):  # type: ignore[no-untyped-def]
    """Render every `step`-th row of tiles from `offset`: image[b, c, y, x]."""
    batch, channels, height, width = image.shape
    rows, cols = -(-height // SIDE), -(-width // SIDE)
    per_tile = SIDE * SIDE * channels
    pixels = np.empty(cols * per_tile, np.float32)
    coefficients = np.empty(5, np.float32)
    for row in range(offset, batch * rows, step):
        for k in range(len(pixels)):
            pixels[k] = 0.0
        mask_at, present = -1, True
        for e in range(lists.start[row], lists.start[row + 1]):
            i = lists.entries[e, 0]
            for col in range(lists.entries[e, 1], lists.entries[e, 2]):
                if lists.num_regions > 0:
                    mask_at, present = _find_mask(lists, row % (lists.maps * rows) * cols + col, lists.regions[i])
                if not present:
                    continue
                first, last = _enter_tile(
                    lists.gaussians[i], row % rows, col, height, width, lists.radius, coefficients
                )
                if first < last:
                    add_rows(  # type: ignore[call-arg]
                        pixels, col * per_tile, first, last, coefficients, lists.lowest, lists.colors, i * channels,
                        lists.masks, mask_at, channels,
                    )  # fmt: skip
        _exchange(pixels, image, row, True)


@program.entry
def gather(lists, offset, step, grad, out, moments):  # type: ignore[no-untyped-def]
    """Fill out[e] for the entries of every `step`-th row of tiles: C colour gradients, 5 moments of z * SCALE."""
    batch, channels, height, width = grad.shape
    rows, cols = -(-height // SIDE), -(-width // SIDE)
    per_tile = SIDE * SIDE * channels
    pixels = np.zeros(cols * per_tile, np.float32)
    coefficients = np.empty(5, np.float32)
    sums = np.empty((channels + 5) * SIDE, np.float32)
    for row in range(offset, batch * rows, step):
        if lists.start[row] == lists.start[row + 1]:
            continue
        _exchange(pixels, grad, row, False)
        mask_at, present = -1, True
        for e in range(lists.start[row], lists.start[row + 1]):
            i = lists.entries[e, 0]
            for k in range(len(sums)):
                sums[k] = 0.0
            for col in range(lists.entries[e, 1], lists.entries[e, 2]):
                if lists.num_regions > 0:
                    mask_at, present = _find_mask(lists, row % (lists.maps * rows) * cols + col, lists.regions[i])
                if not present:
                    continue
                first, last = _enter_tile(
                    lists.gaussians[i], row % rows, col, height, width, lists.radius, coefficients
                )
                if first < last:
                    gather_rows(  # type: ignore[call-arg]
                        pixels, col * per_tile, first, last, coefficients, lists.lowest, lists.colors, i * channels,
                        lists.masks, mask_at, sums, moments, channels,
                    )  # fmt: skip
            for k in range(out.shape[1]):
                out[e, k] = sum_columns(sums, k)  # type: ignore[call-arg]


@program.entry
def finish(lists, order, out, means, cholesky, colors):  # type: ignore[no-untyped-def]
    """Add up each Gaussian's entries in float64 and turn moments into gradients, in the caller's order."""
    count, channels = colors.shape
    total = np.zeros((count, out.shape[1]))
    for e in range(out.shape[0]):
        for k in range(out.shape[1]):
            total[lists.entries[e, 0], k] += out[e, k]
    for i in range(count):
        t, g, to = total[i], lists.gaussians[i], order[i]
        for c in range(channels):
            colors[to, c] = t[c]
        if out.shape[1] > channels:
            s1, s2 = t[channels] / SCALE, t[channels + 1] / SCALE
            s11, s12 = t[channels + 2] / (SCALE * SCALE), t[channels + 3] / (SCALE * SCALE)
            s22 = t[channels + 4] / (SCALE * SCALE)
            slope = g[L21] / g[L22]
            means[to, 0], means[to, 1] = (s1 - slope * s2) / g[L11], s2 / g[L22]
            cholesky[to, 0], cholesky[to, 1] = (s11 - slope * s12) / g[L11], s12 / g[L22]
            cholesky[to, 2] = s22 / g[L22]


def _example() -> tuple[Lists, Any]:
    empty, places, numbers = np.zeros((1, 3), np.int32), np.zeros(2, np.int64), np.zeros(1, np.float32)
    lists = Lists(
        np.ones((1, COLUMNS)), numbers, places, places, empty, 0, 1, places, places, places, numbers, 4.0, numbers[0]
    )
    return lists, np.zeros((1, 6), np.float32)


@program.part
def lists() -> None:
    """Compile what lists tiles, and what ends the gradient."""
    example, terms = _example()
    one, pair, triple = (np.ones((1, n), np.float32) for n in (1, 2, 3))
    in_range(pair, triple, one)
    list_tiles(pair, triple, example.start[:1], example.start, example.start, 1, 1, 1, 4.0)
    finish(example, example.start, terms, pair, triple, one)


@program.part
def pixels() -> None:
    """Compile what visits pixels."""
    example, terms = _example()
    image = np.zeros((1, 1, 1, 1), np.float32)
    render(example, 0, 1, image)
    gather(example, 0, 1, image, terms, True)
