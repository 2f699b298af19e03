"""Bounds of a Gaussian's support: the tiles, and within a tile the rows, that its ellipse |z| <= radius crosses.

`g` is a row of Lists.gaussians, the height and width are of its level's grid, all in nodes.
"""

from __future__ import annotations

import math

from ..compiled import inner
from ..whitened import Z_LIMIT
from .layout import (
    INVERSE_L11,
    L11,
    L21,
    L22,
    MEAN_X,
    MEAN_Y,
    PADDING,
    PEAK,
    SHEAR,
    SIGMA_Y,
    SLOPE1_X,
    SLOPE2_X,
    SLOPE2_Y,
)
from .simd import SIDE

# pixels by which bounds in float64 exceed the support, so that they hold for weights in float32
_MARGIN = 1e-3
# most vectors of a row that a float is rounded to; wide Gaussians are not asked for theirs
_MAX_VECTORS = 99.0


@inner
def bounded(value):  # type: ignore[no-untyped-def]
    """Clamp a coefficient of z."""
    return min(max(value, -Z_LIMIT), Z_LIMIT)


@inner
def _highest(along, across, peak, low, high, radius):  # type: ignore[no-untyped-def]
    """Return the largest along * u + across * sqrt(radius^2 - u^2), which peaks at u = peak, over [low, high]."""
    u = min(max(peak, low), high)
    return along * u + across * math.sqrt(max(radius * radius - u * u, 0.0))


@inner
def tile_rows(g, height, width, radius):  # type: ignore[no-untyped-def]
    """Return the rows of tiles, first and last + 1, that the bounding box crosses; 0, 0: none."""
    reach, spread = g[SIGMA_Y] * radius + _MARGIN, g[L11] * radius + _MARGIN
    first = math.ceil(max(g[MEAN_Y] - reach - 0.5, 0.0))
    last = math.floor(min(g[MEAN_Y] + reach - 0.5, height - 1.0))
    if g[MEAN_X] + spread < 0.5 or g[MEAN_X] - spread > width - 0.5 or first > last:
        return 0, 0
    return first // SIDE, last // SIDE + 1


@inner
def bounding_columns(g, width, radius):  # type: ignore[no-untyped-def]
    """Return the columns of tiles, first and last + 1, that the bounding box crosses."""
    spread = g[L11] * radius + _MARGIN
    first = max(math.ceil(g[MEAN_X] - spread - 0.5), 0) // SIDE
    return first, min(math.floor(g[MEAN_X] + spread - 0.5), width - 1) // SIDE + 1


@inner
def tile_columns(g, row, height, width, radius):  # type: ignore[no-untyped-def]
    """Return the columns of tiles, first and last + 1, that the ellipse crosses in a row of tiles; 0, 0: none."""
    # by the factor of (y, x), whose first standard deviation is that along y
    sigma = g[SIGMA_Y]
    top = max((row * SIDE + 0.5 - _MARGIN - g[MEAN_Y]) / sigma, -radius)
    bottom = min((min(row * SIDE + SIDE, height) - 0.5 + _MARGIN - g[MEAN_Y]) / sigma, radius)
    along, across = g[L11] * g[L21] / sigma, g[L11] * g[L22] / sigma
    right = g[MEAN_X] + _highest(along, across, g[PEAK], top, bottom, radius) + _MARGIN
    left = g[MEAN_X] - _highest(along, across, g[PEAK], -bottom, -top, radius) - _MARGIN
    first = math.ceil(max(left - 0.5, 0.0))
    last = math.floor(min(right - 0.5, width - 1.0))
    return (first // SIDE, last // SIDE + 1) if first <= last else (0, 0)


@inner
def count_vectors(g, radius):  # type: ignore[no-untyped-def]
    """Return the number of vectors that hold the ellipse in every row, around its middle there."""
    return math.ceil(min((g[L11] * g[L22] / g[SIGMA_Y] * radius + 1.0) / (SIDE // 2), _MAX_VECTORS))


@inner
def enter_tile(g, row, col, height, width, radius, coefficients):  # type: ignore[no-untyped-def]
    """Set the coefficients of z * SCALE about the tile's middle; return its rows, first and last + 1, to visit.

    z1 = k0 + k1 x and z2 = k2 + k3 x + k4 y, with k in `coefficients`, float64.
    """
    left = max((col * SIDE + 0.5 - _MARGIN - g[MEAN_X]) * g[INVERSE_L11], -radius)
    right = min((min(col * SIDE + SIDE, width) - 0.5 + _MARGIN - g[MEAN_X]) * g[INVERSE_L11], radius)
    if left > right:
        return 0, 0
    base = row * SIDE
    bottom = g[MEAN_Y] + _highest(g[L21], g[L22], g[PEAK], left, right, radius) + _MARGIN
    top = g[MEAN_Y] - _highest(g[L21], g[L22], g[PEAK], -right, -left, radius) - _MARGIN
    first = math.ceil(max(top - 0.5, float(base)))
    last = math.floor(min(bottom - 0.5, min(base + SIDE, height) - 1.0))
    x, y = col * SIDE + SIDE / 2 - g[MEAN_X], base + SIDE / 2 - g[MEAN_Y]
    coefficients[0] = bounded(g[SLOPE1_X] * x)
    coefficients[1] = g[SLOPE1_X]
    coefficients[2] = bounded(g[SLOPE2_Y] * y + g[SLOPE2_X] * x)
    coefficients[3] = g[SLOPE2_X]
    coefficients[4] = g[SLOPE2_Y]
    return first - base, last + 1 - base


@inner
def enter_rows(g, row, height, width, radius, vectors, shape):  # type: ignore[no-untyped-def]
    """Set the shape of a narrow Gaussian (see rows._ShearedRows); return the rows, first and last + 1, to visit."""
    reach, base = g[SIGMA_Y] * radius + _MARGIN, row * SIDE
    first = max(math.ceil(g[MEAN_Y] - reach - 0.5), base)
    last = min(math.floor(g[MEAN_Y] + reach - 0.5), min(base + SIDE, height) - 1)
    shape[1] = g[SHEAR]
    shape[3] = base + 0.5 - g[MEAN_Y]
    shape[0] = g[MEAN_X] + shape[1] * shape[3] - (SIDE // 2 * vectors - 0.5)
    shape[2], shape[4], shape[5], shape[6] = g[MEAN_X], g[SLOPE1_X], g[SLOPE2_X], g[SLOPE2_Y]
    shape[7], shape[8] = -PADDING, width
    return first - base, last + 1 - base
