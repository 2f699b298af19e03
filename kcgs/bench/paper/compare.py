"""Rows beside each other: of the same picture, at the same N or at the same number of bits."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

from kcgs.bench.maps.gains import interval

from .trials import Row

QUANTITIES = {"psnr": "PSNR", "ms_ssim": "MS-SSIM", "ef_psnr": "EF-PSNR", "ef_ssim": "edge SSIM"}
# drawing among fewer pictures says nothing of others
LEAST = 5
_TIES = {"psnr": 0.005, "ef_psnr": 0.005, "ms_ssim": 0.0001, "ef_ssim": 0.0005}


class Difference(NamedTuple):
    """Mean of differences over pictures, its bootstrap 95 % interval, and how many are won."""

    mean: float
    low: float  # NaN for fewer than LEAST pictures
    high: float
    wins: int
    losses: int
    values: dict[str, float]
    asked: int  # pictures that both methods have, of which some may have no value

    @property
    def is_complete(self) -> bool:
        """Whether it is a mean over all pictures: those that are left out are not so by chance."""
        return len(self.values) == self.asked

    @property
    def worst(self) -> list[str]:
        """Pictures, the lowest first."""
        return sorted(self.values, key=lambda picture: self.values[picture])


class Curve(NamedTuple):
    """Points (bytes, quality) of one picture and method, sorted."""

    points: list[tuple[float, float]]

    def at(self, size: float) -> float:
        """Interpolate over the logarithm of bytes; NaN outside the points."""
        for (low, first), (high, last) in pairwise(self.points):
            if low <= size <= high:
                share = 0.0 if high == low else math.log(size / low) / math.log(high / low)
                return first + share * (last - first)
        return math.nan


def mean(values: Iterable[float]) -> float:
    """Mean of those that are defined; NaN: there are none."""
    defined = [value for value in values if not math.isnan(value)]
    return statistics.fmean(defined) if defined else math.nan


def counts(rows: Iterable[Row], method: str) -> list[int]:
    """N that a method was run with."""
    return sorted({row.n for row in rows if row.method == method})


def select(rows: Iterable[Row], method: str, n: int | None = None) -> list[Row]:
    """Return the rows of a method, of one N or of all."""
    return [row for row in rows if row.method == method and n in (None, row.n)]


def by_picture(rows: Iterable[Row], quantity: str) -> dict[str, float]:
    """Average over seeds."""
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row.picture, []).append(getattr(row, quantity))
    return {picture: mean(found) for picture, found in values.items()}


def complete(rows: Sequence[Row], methods: Iterable[str], n: int) -> list[str]:
    """Pictures that every method has at this N: means over others could not be compared."""
    has = [{row.picture for row in select(rows, method, n)} for method in methods]
    return [picture for picture in dict.fromkeys(row.picture for row in rows) if all(picture in found for found in has)]


def shared(rows: Sequence[Row], methods: Sequence[str]) -> Iterator[tuple[int, list[str], list[str]]]:
    """Go through all N: yield each with the methods that were run with it, and the pictures that all of these have."""
    for n in sorted({n for name in methods for n in counts(rows, name)}):
        present = [name for name in methods if n in counts(rows, name)]
        yield n, present, complete(rows, present, n)


def equal_n(rows: Sequence[Row], ours: str, other: str, n: int, quantity: str) -> Difference | None:
    """Compare scenes of as many Gaussians; None: no picture has both."""
    first, second = (by_picture(select(rows, name, n), quantity) for name in (ours, other))
    return summarize({p: first[p] - second[p] for p in first if p in second}, quantity)


def equal_bits(rows: Sequence[Row], ours: str, other: str, n: int, quantity: str) -> Difference | None:
    """Compare the decoded files with the other's at as many bytes, interpolated between its own of that picture."""
    quantity = f"decoded_{quantity}"
    first, sizes = (by_picture(select(rows, ours, n), q) for q in (quantity, "bytes"))
    both = {row.picture for row in select(rows, other)}
    values = {p: first[p] - curve(rows, other, p, quantity).at(sizes[p]) for p in first if p in both}
    return summarize(values, quantity)


def curve(rows: Sequence[Row], method: str, picture: str, quantity: str) -> Curve:
    """Return quality over bytes, averaged over seeds."""
    here = [row for row in select(rows, method) if row.picture == picture]
    points = []
    for n in sorted({row.n for row in here}):
        found = [row for row in here if row.n == n]
        points.append((mean(row.bytes for row in found), mean(getattr(row, quantity) for row in found)))
    return Curve(sorted(points))


def summarize(values: dict[str, float], quantity: str) -> Difference | None:
    """Sum up differences; undefined ones are left out. None: there are none."""
    asked = len(values)
    values = {picture: value for picture, value in values.items() if math.isfinite(value)}
    if not values:
        return None
    tie = _TIES[quantity.removeprefix("decoded_")]
    low, high = interval(list(values.values())) if len(values) >= LEAST else (math.nan, math.nan)
    return Difference(
        statistics.fmean(values.values()),
        low,
        high,
        sum(value > tie for value in values.values()),
        sum(value < -tie for value in values.values()),
        values,
        asked,
    )
