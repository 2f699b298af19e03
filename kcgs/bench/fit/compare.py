"""Fits beside the baseline: of the same number of Gaussians, or of the same number of bytes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from typing import NamedTuple

from .cases import BASELINE, RIVALS
from .runs import Run, affordable

# a smaller difference in dB is neither a win nor a loss
TIE = 0.005


class Pair(NamedTuple):
    """A fit and the baseline's fit of the same picture."""

    ours: Run
    baseline: Run

    @property
    def psnr(self) -> float:
        """Difference in dB; above zero where ours is better."""
        return self.ours.psnr - self.baseline.psnr

    @property
    def ef_psnr(self) -> float:
        """Difference in dB in the band along the contours."""
        return self.ours.ef_psnr - self.baseline.ef_psnr


class Spread(NamedTuple):
    """What differences in dB come to."""

    mean: float
    deviation: float  # NaN for fewer than two
    wins: int
    losses: int
    worst: str  # the name with the lowest
    lowest: float


class Runs:
    """Runs by group."""

    def __init__(self, runs: Iterable[Run]) -> None:
        self.all = list(runs)

    def find(self, group: str, image: str, n: int, name: str) -> Run | None:
        """One run, or None."""
        return next((r for r in self.all if (r.group, r.image, r.n, r.name) == (group, image, n, name)), None)

    def of(self, group: str, name: str | None = None, n: int | None = None) -> list[Run]:
        """Runs of a group, of one recipe or of all, at one N or at all."""
        return [r for r in self.all if r.group == group and name in (None, r.name) and n in (None, r.n)]

    def counts(self, group: str) -> list[int]:
        """N that recipes are compared at: what equal bytes buy the baseline is not among them."""
        rivals = {r.n for r in self.of(group) if r.name != BASELINE}
        return sorted(rivals or {r.n for r in self.of(group)})

    def names(self, group: str) -> list[str]:
        """Recipes of a group, in order."""
        return list(dict.fromkeys(r.name for r in self.of(group)))

    def rivals(self, group: str) -> list[str]:
        """Recipes that are compared with the baseline."""
        return [name for name in RIVALS if name in self.names(group)]

    def pairs(self, group: str, n: int, name: str, *, equal_bytes: bool = False) -> list[Pair]:
        """Fits of a recipe beside the baseline's, by default of as many Gaussians; those that lack one are left out."""
        found = []
        for ours in self.of(group, name, n):
            other = self.find(group, ours.image, affordable(ours) if equal_bytes else n, BASELINE)
            if other is not None:
                found.append(Pair(ours, other))
        return found


def spread(pairs: Iterable[Pair], quantity: str) -> Spread | None:
    """Sum up the differences in `quantity`, psnr or ef_psnr; undefined ones are left out. None: there are none."""
    values = {p.ours.image: getattr(p, quantity) for p in pairs}
    values = {image: value for image, value in values.items() if not math.isnan(value)}
    if not values:
        return None
    worst = min(values, key=lambda image: values[image])
    return Spread(
        statistics.fmean(values.values()),
        statistics.stdev(values.values()) if len(values) > 1 else math.nan,
        sum(value > TIE for value in values.values()),
        sum(value < -TIE for value in values.values()),
        worst,
        values[worst],
    )


def winner(difference: float, name: str) -> str:
    """Name who is ahead."""
    if math.isnan(difference):
        return ""
    return "even" if abs(difference) <= TIE else name if difference > 0 else BASELINE


def seconds_to_pass(run: Run, psnr: float) -> float:
    """Seconds after which the history of `run` first has this PSNR; NaN: never."""
    return next((entry.seconds for entry in run.history if entry.psnr >= psnr), math.nan)


def mean(values: Iterable[float]) -> float:
    """Mean of those that are defined; NaN: there are none."""
    defined = [value for value in values if not math.isnan(value)]
    return statistics.fmean(defined) if defined else math.nan
