"""Means over images with bootstrap intervals, and differences between curves."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import PchipInterpolator

# (rate, quality) of each file
Curve = Sequence[tuple[float, float]]
_Floats = NDArray[np.float64]
_SAMPLES = 10_000


class Summary(NamedTuple):
    """Mean of differences over images, its bootstrap 95 % interval, and how many are won."""

    mean: float
    low: float
    high: float
    wins: int
    losses: int
    values: dict[str, float]  # by image, without those where the difference is not defined
    asked: int  # images, with those where it is not

    @property
    def is_complete(self) -> bool:
        """Whether it is a mean over all images: those that are left out are not so by chance."""
        return len(self.values) == self.asked

    @property
    def worst(self) -> list[str]:
        """Images, the lowest first."""
        return sorted(self.values, key=lambda image: self.values[image])


class Delta(NamedTuple):
    """What one curve has over another; NaN where they do not overlap."""

    rate: float  # in %, below zero where it needs fewer bits for the same quality
    quality: float  # above zero where it is better at the same bits
    overlap: float  # of their ranges of quality, in its unit


def mean(values: Iterable[float]) -> float:
    """Mean of the values that are defined; NaN: there are none."""
    defined = [value for value in values if not math.isnan(value)]
    return statistics.fmean(defined) if defined else math.nan


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Bootstrap 95 % interval of the mean; images are sampled, so that the two fits of one stay a pair.

    Percentiles of few images lie too near to the mean, by as much as the normal distribution's do beside Student's,
    and by sqrt((n - 1) / n); they are moved away from it by these factors.
    """
    count, centre = len(values), statistics.fmean(values)
    samples = np.random.default_rng(0).choice(np.asarray(values), (_SAMPLES, count))
    low, high = np.percentile(samples.mean(axis=1), (2.5, 97.5))
    if count == 1:
        return float(low), float(high)
    wider = float(stats.t.ppf(0.975, count - 1) / stats.norm.ppf(0.975)) * math.sqrt(count / (count - 1))
    return centre + wider * float(low - centre), centre + wider * float(high - centre)


def summarize(values: Mapping[str, float], tie: float, *, least: int = 1) -> Summary | None:
    """Sum up differences by image; None: none is defined. Fewer images than `least` have no interval."""
    finite = {image: value for image, value in values.items() if math.isfinite(value)}
    if not finite:
        return None
    low, high = interval(list(finite.values())) if len(finite) >= least else (math.nan, math.nan)
    wins, losses = (sum(sign * value > tie for value in finite.values()) for sign in (1, -1))
    return Summary(statistics.fmean(finite.values()), low, high, wins, losses, finite, len(values))


def interpolate(curve: Curve, rate: float) -> float:
    """Quality at a rate, linear over the logarithm of the rate; NaN outside the sorted points."""
    rates, qualities = np.array(curve, np.float64).reshape(-1, 2).T
    return float(np.interp(math.log(rate), np.log(rates), qualities, math.nan, math.nan)) if len(rates) else math.nan


def delta(ours: Curve, other: Curve) -> Delta:
    """Bjontegaard's mean differences between two curves of quality over rate.

    Log-rate is interpolated over quality, quality over log-rate, by monotone piecewise cubics (PCHIP, as in later forms
    of the measure: the first one's single cubic swings between few points), and averaged where both curves are.
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
