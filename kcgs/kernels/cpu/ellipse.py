"""Bounds of a Gaussian's support: the tiles, and within a tile the rows, that its ellipse |z| <= radius crosses.

`g` is a row of Lists.gaussians; `height` and `width` are the size of its level's grid; lengths are in nodes.
"""

from __future__ import annotations

import math

from kcgs.compiled.program import inline

from ..whitened import Z_LIMIT
from .layout import (
    CHANGE,
    INVERSE_L11,
    L11,
    L21,
    L22,
    MEAN_X,
    MEAN_Y,
    PEAK,
    SIGMA_Y,
    SLOPE1_X,
    SLOPE2_X,
    SLOPE2_Y,
)
from .simd import HALF, SIDE

# pixels by which bounds in float64 exceed the support, so that they hold for weights in float32
_MARGIN = 1e-3


@inline
def clamp_coefficient(value):
    """Clamp a coefficient of z."""
    return min(max(value, -Z_LIMIT), Z_LIMIT)


@inline
def _highest(along, across, peak, low, high, radius):
    """Return the largest along * u + across * sqrt(radius^2 - u^2), which peaks at u = peak, over [low, high]."""
    u = min(max(peak, low), high)
    return along * u + across * math.sqrt(max(radius * radius - u * u, 0.0))


@inline
def tile_rows(g, height, width, radius):
    """Return the rows of tiles, first and last + 1, that the bounding box crosses; 0, 0: none."""
    reach, spread = g[SIGMA_Y] * radius + _MARGIN, g[L11] * radius + _MARGIN
    first = math.ceil(max(g[MEAN_Y] - reach - 0.5, 0.0))
    last = math.floor(min(g[MEAN_Y] + reach - 0.5, height - 1.0))
    if g[MEAN_X] + spread < 0.5 or g[MEAN_X] - spread > width - 0.5 or first > last:
        return 0, 0
    return first // SIDE, last // SIDE + 1


@inline
def row_halves(g, row, height, width, radius):
    """Return the halves of tiles, first and last + 1, that the ellipse may cross in a row of tiles."""
    spread = g[L11] * radius + _MARGIN
    first, last = max(g[MEAN_X] - spread - 0.5, 0.0), min(g[MEAN_X] + spread - 0.5, width - 1.0)
    if last - first < SIDE:  # block_rows has tighter bounds at less cost
        return (int(first) // HALF, int(last) // HALF + 1) if first <= last else (0, 0)
    # the Cholesky factor of (y, x) begins with the standard deviation along y
    sigma = g[SIGMA_Y]
    top = max((row * SIDE + 0.5 - _MARGIN - g[MEAN_Y]) / sigma, -radius)
    bottom = min((min(row * SIDE + SIDE, height) - 0.5 + _MARGIN - g[MEAN_Y]) / sigma, radius)
    along, across = g[L11] * g[L21] / sigma, g[L11] * g[L22] / sigma
    right = g[MEAN_X] + _highest(along, across, radius * g[PEAK], top, bottom, radius) + _MARGIN
    left = g[MEAN_X] - _highest(along, across, radius * g[PEAK], -bottom, -top, radius) - _MARGIN
    first = math.ceil(max(left - 0.5, 0.0))
    last = math.floor(min(right - 0.5, width - 1.0))
    return (first // HALF, last // HALF + 1) if first <= last else (0, 0)


@inline
def block_rows(g, row, col, height, width, radius):
    """Return the rows of a block, first and last + 1, that the ellipse crosses; first >= last: none."""
    left = max((col * SIDE + 0.5 - _MARGIN - g[MEAN_X]) * g[INVERSE_L11], -radius)
    right = min((min(col * SIDE + SIDE, width) - 0.5 + _MARGIN - g[MEAN_X]) * g[INVERSE_L11], radius)
    if left > right:
        return 0, 0
    base = row * SIDE
    bottom = g[MEAN_Y] + _highest(g[L21], g[L22], radius * g[PEAK], left, right, radius) + _MARGIN
    top = g[MEAN_Y] - _highest(g[L21], g[L22], radius * g[PEAK], -right, -left, radius) - _MARGIN
    first = math.ceil(max(top - 0.5, float(base)))
    last = math.floor(min(bottom - 0.5, min(base + SIDE, height) - 1.0))
    return first - base, last + 1 - base


@inline
def set_shape(g, row, col, first, shape):
    """Set `shape`, float32, to k of z1 = k0 + k1 x and z2 = k2 + k3 x + k4 y, to CHANGE, and to y of the first row.

    z is multiplied by SCALE; x and y are nodes from the block's middle.
    """
    x, y = col * SIDE + SIDE / 2 - g[MEAN_X], row * SIDE + SIDE / 2 - g[MEAN_Y]
    shape[0] = clamp_coefficient(g[SLOPE1_X] * x)
    shape[1] = g[SLOPE1_X]
    shape[2] = clamp_coefficient(g[SLOPE2_Y] * y + g[SLOPE2_X] * x)
    shape[3] = g[SLOPE2_X]
    shape[4] = g[SLOPE2_Y]
    shape[5] = g[CHANGE]
    shape[6] = first - (SIDE - 1) / 2
