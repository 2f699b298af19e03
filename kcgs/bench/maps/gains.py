"""What gains come to over images, and the bounds that they are held to."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from .trials import Result

# mean gains in PSNR and EF-PSNR that an automatic map must bring, by N
LEAST = {400: (0.4, 0.8), 1_000: (0.1, 0.3)}
# and the loss in PSNR that no image may pass
MOST_LOSS = 0.1
# a smaller difference in dB is neither a win nor a loss
TIE = 0.005
_DRAWS = 10_000


class Gain(NamedTuple):
    """Mean over images and its bootstrap 95 % interval, in dB."""

    mean: float
    low: float
    high: float
    wins: int
    losses: int
    worst: str  # the image with the least
    least: float


class Bound(NamedTuple):
    """A bound, what was measured, and whether it is met."""

    what: str
    bound: float
    measured: float
    met: bool


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Bootstrap 95 % interval of the mean; images are drawn, so that the two fits of one stay a pair.

    Percentiles of few images lie too near to the mean, by as much as the normal distribution's do beside Student's,
    and by sqrt((n - 1) / n); they are moved away from it by these factors.

    Args:
        values: differences, one an image, at least one.

    Example:
        >>> interval([0.5, 0.5])
        (0.5, 0.5)
    """
    from scipy import stats

    count, centre = len(values), statistics.fmean(values)
    drawn = np.random.default_rng(0).choice(np.asarray(values), (_DRAWS, count))
    low, high = np.percentile(drawn.mean(axis=1), (2.5, 97.5))
    if count == 1:
        return float(low), float(high)
    wider = float(stats.t.ppf(0.975, count - 1) / stats.norm.ppf(0.975)) * math.sqrt(count / (count - 1))
    return centre + wider * float(low - centre), centre + wider * float(high - centre)


def gain_of(results: Iterable[Result], quantity: str) -> Gain | None:
    """Sum up a gain of results, by name; images where it is not defined are left out. None: it is nowhere."""
    values = {r.image: float(getattr(r, quantity)) for r in results}
    values = {image: value for image, value in values.items() if not math.isnan(value)}
    if not values:
        return None
    worst = min(values, key=lambda image: values[image])
    return Gain(
        statistics.fmean(values.values()),
        *interval(list(values.values())),
        sum(value > TIE for value in values.values()),
        sum(value < -TIE for value in values.values()),
        worst,
        values[worst],
    )


def bounds(results: Sequence[Result]) -> list[Bound]:
    """Hold the automatic maps to the bounds of every N that was run."""
    found = []
    for n, least in LEAST.items():
        here = [r for r in results if r.n == n]
        for quantity, name, bound in zip(("gain", "ef_gain"), ("PSNR", "EF-PSNR"), least, strict=True):
            gain = gain_of(here, quantity)
            if gain is not None:
                found.append(Bound(f"N = {n:,}: mean {name} gained, at least", bound, gain.mean, gain.mean >= bound))
        gain = gain_of(here, "gain")
        if gain is not None:
            what = f"N = {n:,}: PSNR gained on the worst image ({gain.worst}), at least"
            found.append(Bound(what, -MOST_LOSS, gain.least, gain.least >= -MOST_LOSS))
    return found
