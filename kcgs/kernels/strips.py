"""The loops of the CPU kernel: bands of 16 rows, and in each its Gaussians, strip by strip of 16 columns.

A band belongs to one thread, so nothing is shared and the result does not depend on the number of threads. Within a
strip only the rows that the ellipse crosses are visited.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from numba import njit

from .form import Z_LIMIT
from .lanes import add_rows, gather_rows
from .simd import lane_sum

SIDE = 16
# z * SCALE, squared, is an exponent of 2
SCALE = math.sqrt(0.5 / math.log(2.0))
# pixels by which geometry in float64 is kept on the safe side of the weights in float32
MARGIN = 1e-3

# columns of the table of Gaussians: mean, factor, standard deviation along y, 1 / l11, where the ellipse is highest
# (in standard deviations along x), and the slopes of z1 along x and of z2 along x and y, times SCALE
MX, MY, L11, L21, L22, HEIGHT, INVERSE, PEAK, RISE1, RISE2, RISE3 = range(11)
COLUMNS = 11


# called from compiled code alone: without entry points for Python to call they compile in less time
_inner = cast(Any, njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")


class Scene(NamedTuple):
    """Everything the loops read, as arrays."""

    gaussians: Any  # [N, COLUMNS] float64, sorted
    colors: Any  # [N * C] float32
    regions: Any  # [N] int64
    start: Any  # [bands + 1] int64
    entries: Any  # [E, 3] int32: Gaussian, first strip, last strip + 1
    num_regions: int  # 0: no map
    maps: int  # label maps, 1 or as many as images
    keys: Any  # [K] int64, tile * num_regions + region
    tile_start: Any  # [tiles + 1] int64 into keys
    plane: Any  # [K] int64 row of planes, -1: alone in its tile
    planes: Any  # [P * 256] float32
    radius: float  # largest |z|
    lowest: Any  # float32, least exponent of 2


@_inner
def _bounded(value):  # type: ignore[no-untyped-def]
    return min(max(value, -Z_LIMIT), Z_LIMIT)


@_inner
def _tabulate(means, factors, order, radius):  # type: ignore[no-untyped-def]
    table = np.empty((len(order), COLUMNS))
    for i in range(len(order)):
        g, given = table[i], order[i]
        g[MX], g[MY] = means[given, 0], means[given, 1]
        g[L11], g[L21], g[L22] = factors[given, 0], factors[given, 1], factors[given, 2]
        g[HEIGHT] = math.hypot(g[L21], g[L22])
        g[INVERSE] = 1.0 / g[L11]
        g[PEAK] = radius * g[L21] / g[HEIGHT]
        g[RISE1] = _bounded(SCALE / g[L11])
        g[RISE2] = _bounded(-SCALE * (g[L21] / g[L11]) / g[L22])
        g[RISE3] = _bounded(SCALE / g[L22])
    return table


@_inner
def _highest(along, across, peak, low, high, radius):  # type: ignore[no-untyped-def]
    """Return the largest along * u + across * sqrt(radius^2 - u^2), which peaks at u = peak, over [low, high]."""
    u = min(max(peak, low), high)
    return along * u + across * math.sqrt(max(radius * radius - u * u, 0.0))


@_inner
def _row_range(g, height, width, radius):  # type: ignore[no-untyped-def]
    reach, spread = g[HEIGHT] * radius + MARGIN, g[L11] * radius + MARGIN
    first = math.ceil(max(g[MY] - reach - 0.5, 0.0))
    last = math.floor(min(g[MY] + reach - 0.5, height - 1.0))
    if g[MX] + spread < 0.5 or g[MX] - spread > width - 0.5 or first > last:
        return 0, 0
    return first // SIDE, last // SIDE + 1


@_inner
def _strip_range(g, band, height, width, radius):  # type: ignore[no-untyped-def]
    # the ellipse's columns within the band, by the factor of (y, x)
    h = g[HEIGHT]
    top = max((band * SIDE + 0.5 - MARGIN - g[MY]) / h, -radius)
    bottom = min((min(band * SIDE + SIDE, height) - 0.5 + MARGIN - g[MY]) / h, radius)
    along, across = g[L11] * g[L21] / h, g[L11] * g[L22] / h
    right = g[MX] + _highest(along, across, g[PEAK], top, bottom, radius) + MARGIN
    left = g[MX] - _highest(along, across, g[PEAK], -bottom, -top, radius) - MARGIN
    first = math.ceil(max(left - 0.5, 0.0))
    last = math.floor(min(right - 0.5, width - 1.0))
    return (first // SIDE, last // SIDE + 1) if first <= last else (0, 0)


@_inner
def _list_bands(gaussians, regions, images, rows, batch, height, width, radius):  # type: ignore[no-untyped-def]
    """Start of each band in the list, and the list: Gaussian, first strip, last strip + 1."""
    count = gaussians.shape[0]
    start = np.zeros(batch * rows + 1, np.int64)
    span = np.zeros((count, 2), np.int64)
    for i in range(count):
        if regions[i] >= 0:
            span[i, 0], span[i, 1] = _row_range(gaussians[i], height, width, radius)
        for band in range(span[i, 0], span[i, 1]):
            start[images[i] * rows + band + 1] += 1
    for b in range(batch * rows):
        start[b + 1] += start[b]
    at = start[:-1].copy()
    entries = np.empty((start[-1], 3), np.int32)
    for i in range(count):
        for band in range(span[i, 0], span[i, 1]):
            b = images[i] * rows + band
            first, last = _strip_range(gaussians[i], band, height, width, radius)
            entries[at[b], 0], entries[at[b], 1], entries[at[b], 2] = i, first, last
            at[b] += 1
    return start, entries


@_inner
def _find_plane(scene, tile, region):  # type: ignore[no-untyped-def]
    """Offset of the membership weights: negative where the region is alone in the tile; and whether it is there."""
    key = tile * scene.num_regions + region
    low, high = scene.tile_start[tile], scene.tile_start[tile + 1]
    end = high
    while low < high:
        middle = (low + high) // 2
        if scene.keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    if low == end or scene.keys[low] != key:
        return -1, False
    return scene.plane[low] * SIDE * SIDE, True


@_inner
def _enter_strip(g, strip, band, height, width, radius, coefficients):  # type: ignore[no-untyped-def]
    """Set the coefficients of z * SCALE about the strip's middle; return the rows, first and last + 1, to visit."""
    left = max((strip * SIDE + 0.5 - MARGIN - g[MX]) * g[INVERSE], -radius)
    right = min((min(strip * SIDE + SIDE, width) - 0.5 + MARGIN - g[MX]) * g[INVERSE], radius)
    if left > right:
        return 0, 0
    base = band * SIDE
    bottom = g[MY] + _highest(g[L21], g[L22], g[PEAK], left, right, radius) + MARGIN
    top = g[MY] - _highest(g[L21], g[L22], g[PEAK], -right, -left, radius) - MARGIN
    first = math.ceil(max(top - 0.5, float(base)))
    last = math.floor(min(bottom - 0.5, min(base + SIDE, height) - 1.0))
    x, y = strip * SIDE + SIDE / 2 - g[MX], base + SIDE / 2 - g[MY]
    coefficients[0] = _bounded(g[RISE1] * x)
    coefficients[1] = g[RISE1]
    coefficients[2] = _bounded(g[RISE3] * y + g[RISE2] * x)
    coefficients[3] = g[RISE2]
    coefficients[4] = g[RISE3]
    return first - base, last + 1 - base


@_inner
def _write_band(strip, image, b, band, cols):  # type: ignore[no-untyped-def]
    channels, height, width = image.shape[1:]
    for r in range(min(SIDE, height - band * SIDE)):
        for c in range(channels):
            line = image[b, c, band * SIDE + r]
            for s in range(width // SIDE):
                at = ((s * SIDE + r) * channels + c) * SIDE
                for k in range(SIDE):
                    line[s * SIDE + k] = strip[at + k]
            at = (((cols - 1) * SIDE + r) * channels + c) * SIDE
            for k in range(width - width // SIDE * SIDE):
                line[width // SIDE * SIDE + k] = strip[at + k]


@_inner
def _read_band(strip, image, b, band, cols):  # type: ignore[no-untyped-def]
    channels, height, width = image.shape[1:]
    for r in range(min(SIDE, height - band * SIDE)):
        for c in range(channels):
            line = image[b, c, band * SIDE + r]
            for s in range(width // SIDE):
                at = ((s * SIDE + r) * channels + c) * SIDE
                for k in range(SIDE):
                    strip[at + k] = line[s * SIDE + k]
            at = (((cols - 1) * SIDE + r) * channels + c) * SIDE
            for k in range(width - width // SIDE * SIDE):
                strip[at + k] = line[width // SIDE * SIDE + k]


@_inner
def _draw_band(scene, band, image, strip, coefficients, tag):  # type: ignore[no-untyped-def]
    channels, height, width = image.shape[1:]
    rows, cols = -(-height // SIDE), -(-width // SIDE)
    per_strip = SIDE * SIDE * channels
    for k in range(len(strip)):
        strip[k] = 0.0
    plane_at, there = -1, True
    for e in range(scene.start[band], scene.start[band + 1]):
        i = scene.entries[e, 0]
        for s in range(scene.entries[e, 1], scene.entries[e, 2]):
            if scene.num_regions > 0:
                plane_at, there = _find_plane(scene, band % (scene.maps * rows) * cols + s, scene.regions[i])
            if not there:
                continue
            first, last = _enter_strip(scene.gaussians[i], s, band % rows, height, width, scene.radius, coefficients)
            if first < last:
                add_rows(
                    strip, s * per_strip, first, last, coefficients, scene.lowest, scene.colors, i * channels,
                    scene.planes, plane_at, tag,
                )  # fmt: skip
    _write_band(strip, image, band // rows, band % rows, cols)


@_inner
def _gather_band(scene, band, grad, strip, coefficients, sums, out, moments, tag):  # type: ignore[no-untyped-def]
    channels, height, width = grad.shape[1:]
    rows, cols = -(-height // SIDE), -(-width // SIDE)
    per_strip = SIDE * SIDE * channels
    _read_band(strip, grad, band // rows, band % rows, cols)
    plane_at, there = -1, True
    for e in range(scene.start[band], scene.start[band + 1]):
        i = scene.entries[e, 0]
        for k in range(len(sums)):
            sums[k] = 0.0
        for s in range(scene.entries[e, 1], scene.entries[e, 2]):
            if scene.num_regions > 0:
                plane_at, there = _find_plane(scene, band % (scene.maps * rows) * cols + s, scene.regions[i])
            if not there:
                continue
            first, last = _enter_strip(scene.gaussians[i], s, band % rows, height, width, scene.radius, coefficients)
            if first < last:
                gather_rows(
                    strip, s * per_strip, first, last, coefficients, scene.lowest, scene.colors, i * channels,
                    scene.planes, plane_at, sums, moments, tag,
                )  # fmt: skip
        for k in range(out.shape[1]):
            out[e, k] = lane_sum(sums, k)  # type: ignore[call-arg]


@_inner
def _finish(scene, order, out, means, cholesky, colors):  # type: ignore[no-untyped-def]
    count, channels = colors.shape
    total = np.zeros((count, out.shape[1]))
    for e in range(out.shape[0]):
        for k in range(out.shape[1]):
            total[scene.entries[e, 0], k] += out[e, k]
    for i in range(count):
        t, g, to = total[i], scene.gaussians[i], order[i]
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


class Loops(NamedTuple):
    """The compiled entry points."""

    list_bands: Callable[..., Any]
    draw: Callable[..., None]
    gather: Callable[..., None]
    finish: Callable[..., None]


def compile_loops(fingerprint: str, cache: bool) -> Loops:
    """Make the entry points; they compile when called and are kept on disk (`cache`) by `fingerprint` of the sources.

    numba looks at one file only to tell whether its disk cache is stale, and these loops span three; what a function
    closes over is part of the key.
    """
    entry = cast(Any, njit)(cache=cache, nogil=True, no_cfunc_wrapper=True, error_model="numpy")

    @entry
    def list_bands(means, factors, order, regions, images, batch, height, width, radius):  # type: ignore[no-untyped-def]
        """Make the table of Gaussians, the start of each band in the list, and the list."""
        fingerprint  # noqa: B018
        table = _tabulate(means, factors, order, radius)
        start, entries = _list_bands(table, regions, images, -(-height // SIDE), batch, height, width, radius)
        return table, start, entries

    @entry
    def draw(scene, offset, step, image, tag):  # type: ignore[no-untyped-def]
        """Draw every `step`-th band from `offset`: image[b, c, y, x]."""
        fingerprint  # noqa: B018
        batch, channels, height, width = image.shape
        strip = np.empty(-(-width // SIDE) * SIDE * SIDE * channels, np.float32)
        coefficients = np.empty(5, np.float32)
        for band in range(offset, batch * -(-height // SIDE), step):
            _draw_band(scene, band, image, strip, coefficients, tag)

    @entry
    def gather(scene, offset, step, grad, out, moments, tag):  # type: ignore[no-untyped-def]
        """Fill out[e] for the entries of every `step`-th band: C colour gradients, then five moments of z * SCALE."""
        fingerprint  # noqa: B018
        batch, channels, height, width = grad.shape
        strip = np.zeros(-(-width // SIDE) * SIDE * SIDE * channels, np.float32)
        coefficients = np.empty(5, np.float32)
        sums = np.empty((channels + 5) * SIDE, np.float32)
        for band in range(offset, batch * -(-height // SIDE), step):
            if scene.start[band] < scene.start[band + 1]:
                _gather_band(scene, band, grad, strip, coefficients, sums, out, moments, tag)

    @entry
    def finish(scene, order, out, means, cholesky, colors):  # type: ignore[no-untyped-def]
        """Add up each Gaussian's entries in float64 and turn moments into gradients, in the caller's order."""
        fingerprint  # noqa: B018
        _finish(scene, order, out, means, cholesky, colors)

    return Loops(list_bands, draw, gather, finish)
