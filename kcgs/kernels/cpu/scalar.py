"""The scalar twins of the vector loops."""

from __future__ import annotations

import numpy as np

from ..compiled import inner
from .simd import SIDE

_MIDDLE = (SIDE - 1) / 2


@inner
def _weight(coefficients, row, column, lowest):  # type: ignore[no-untyped-def]
    x, y = np.float32(column - _MIDDLE), np.float32(row - _MIDDLE)
    first = coefficients[0] + coefficients[1] * x
    second = coefficients[2] + coefficients[3] * x + coefficients[4] * y
    exponent = -first * first - second * second
    weight = np.exp2(exponent) if exponent >= lowest else np.float32(0.0)
    return first, second, weight


@inner
def add_rows(  # type: ignore[no-untyped-def]
    pixels, offset, first, last, coefficients, lowest, colors, color_at, masks, mask_at, channels
):
    """Add a Gaussian to rows of a tile."""
    for row in range(first, last):
        for column in range(SIDE):
            _, _, weight = _weight(coefficients, row, column, lowest)
            if mask_at >= 0:
                weight *= masks[mask_at + row * SIDE + column]
            for c in range(channels):
                pixels[offset + (row * channels + c) * SIDE + column] += weight * colors[color_at + c]


@inner
def gather_rows(  # type: ignore[no-untyped-def]
    pixels, offset, first, last, coefficients, lowest, colors, color_at, masks, mask_at, sums, moments, channels
):
    """Add a Gaussian's gradient terms over rows of a tile."""
    for row in range(first, last):
        for column in range(SIDE):
            z1, z2, weight = _weight(coefficients, row, column, lowest)
            if mask_at >= 0:
                weight *= masks[mask_at + row * SIDE + column]
            value = np.float32(0.0)
            for c in range(channels):
                g = pixels[offset + (row * channels + c) * SIDE + column]
                value += g * colors[color_at + c]
                sums[c * SIDE + column] += weight * g
            if not moments:
                continue
            value *= weight
            k = channels * SIDE + column
            sums[k] += value * z1
            sums[k + SIDE] += value * z2
            sums[k + 2 * SIDE] += value * z1 * z1
            sums[k + 3 * SIDE] += value * z1 * z2
            sums[k + 4 * SIDE] += value * z2 * z2
