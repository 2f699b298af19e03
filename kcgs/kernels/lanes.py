"""The scalar twins of the vector loops, and the choice between them.

The choice is made when a kernel is compiled, by the type of its `tag`: a tuple as long as the image has channels, of
integers for the vector loops and of floats for the scalar ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

from . import simd

LANES = simd.LANES
_MIDDLE = (LANES - 1) / 2


@njit
def _weight(coefficients, row, lane, lowest):  # type: ignore[no-untyped-def]
    first = coefficients[0] + coefficients[1] * np.float32(lane - _MIDDLE)
    second = (
        coefficients[2] + coefficients[3] * np.float32(lane - _MIDDLE) + coefficients[4] * np.float32(row - _MIDDLE)
    )
    exponent = -first * first - second * second
    weight = np.exp2(exponent) if exponent >= lowest else np.float32(0.0)
    return first, second, weight


@njit
def _scalar_add_rows(  # type: ignore[no-untyped-def]
    strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, tag
):
    channels = len(tag)
    for row in range(first, last):
        for lane in range(LANES):
            _, _, weight = _weight(coefficients, row, lane, lowest)
            if plane_at >= 0:
                weight *= planes[plane_at + row * LANES + lane]
            for c in range(channels):
                strip[at + (row * channels + c) * LANES + lane] += weight * colors[color_at + c]


@njit
def _scalar_gather_rows(  # type: ignore[no-untyped-def]
    strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, sums, moments, tag
):
    channels = len(tag)
    for row in range(first, last):
        for lane in range(LANES):
            z1, z2, weight = _weight(coefficients, row, lane, lowest)
            if plane_at >= 0:
                weight *= planes[plane_at + row * LANES + lane]
            value = np.float32(0.0)
            for c in range(channels):
                g = strip[at + (row * channels + c) * LANES + lane]
                value += g * colors[color_at + c]
                sums[c * LANES + lane] += weight * g
            if not moments:
                continue
            value *= weight
            k = channels * LANES + lane
            sums[k] += value * z1
            sums[k + LANES] += value * z2
            sums[k + 2 * LANES] += value * z1 * z1
            sums[k + 3 * LANES] += value * z1 * z2
            sums[k + 4 * LANES] += value * z2 * z2


def add_rows(*arguments: Any) -> None:
    """Add a Gaussian to rows of a strip; only inside compiled code."""
    raise NotImplementedError


def gather_rows(*arguments: Any) -> None:
    """Add a Gaussian's gradient terms over rows of a strip; only inside compiled code."""
    raise NotImplementedError


@overload(add_rows)
def _choose_add_rows(  # type: ignore[no-untyped-def]
    strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, tag
):
    chosen: Any = simd.add_rows if isinstance(tag.dtype, types.Integer) else _scalar_add_rows

    def call(  # type: ignore[no-untyped-def]
        strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, tag
    ):
        return chosen(strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, tag)

    return call


@overload(gather_rows)
def _choose_gather_rows(  # type: ignore[no-untyped-def]
    strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, sums, moments, tag
):
    chosen: Any = simd.gather_rows if isinstance(tag.dtype, types.Integer) else _scalar_gather_rows

    def call(  # type: ignore[no-untyped-def]
        strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, sums, moments, tag
    ):
        return chosen(
            strip, at, first, last, coefficients, lowest, colors, color_at, planes, plane_at, sums, moments, tag
        )

    return call
