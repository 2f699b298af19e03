"""Bjontegaard's mean differences between two curves of quality over rate.

Log-rate is interpolated over quality, quality over log-rate, by monotone piecewise cubics (PCHIP, as in later forms of
the measure: the first one's single cubic swings between few points), and averaged where both curves are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

# bytes or bits, quality
Curve = Sequence[tuple[float, float]]
_Floats = NDArray[np.float64]


class Delta(NamedTuple):
    """What one curve has over another; NaN where they do not overlap."""

    rate: float  # %, below zero where it needs fewer bits for the same quality
    quality: float  # above zero where it is better at the same bits
    overlap: float  # of their ranges of quality, in its unit


def delta(ours: Curve, other: Curve) -> Delta:
    """Compare two curves.

    Args:
        ours: (rate, quality) of each file.
        other: of the other codec.

    Returns:
        Mean differences of ours to the other.

    Example:
        >>> curve = [(1000.0, 25.0), (2000.0, 28.0), (4000.0, 31.0)]
        >>> found = delta([(0.5 * rate, quality) for rate, quality in curve], curve)
        >>> round(found.rate, 6), round(found.quality, 6), found.overlap
        (-50.0, 3.0, 6.0)
    """
    (log_a, quality_a), (log_b, quality_b) = _rising(ours), _rising(other)
    if min(len(log_a), len(log_b)) < 2:
        return Delta(math.nan, math.nan, 0.0)
    low, high = max(quality_a[0], quality_b[0]), min(quality_a[-1], quality_b[-1])
    octaves = _mean_difference(quality_a, log_a, quality_b, log_b)
    quality = _mean_difference(log_a, quality_a, log_b, quality_b)
    return Delta(100 * (2.0**octaves - 1), quality, max(0.0, float(high - low)))


def _rising(curve: Curve) -> tuple[_Floats, _Floats]:
    """Return log2 of rates and qualities; a file that a smaller one beats is no part of the curve."""
    best, kept = -math.inf, []
    for rate, quality in sorted(curve, key=lambda point: (point[0], -point[1])):
        if quality > best:
            kept.append((rate, quality))
            best = quality
    rates, qualities = np.array(kept, np.float64).reshape(-1, 2).T
    return np.log2(rates), qualities


def _mean_difference(x_a: _Floats, y_a: _Floats, x_b: _Floats, y_b: _Floats) -> float:
    low, high = max(x_a[0], x_b[0]), min(x_a[-1], x_b[-1])
    if high <= low:
        return math.nan
    area = [PchipInterpolator(x, y).integrate(low, high) for x, y in ((x_a, y_a), (x_b, y_b))]
    return float((area[0] - area[1]) / (high - low))
