"""Differences between two methods, paired by image, with their intervals, and the images on which a method is worse."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.interpolate import PchipInterpolator

from .run import Row
from .tables import column_of, format_value, group_by, is_missing, markdown, title

# samples of the bootstrap
_NUM_SAMPLES = 10_000
# a curve is continued so far beyond its ends, in the logarithm of bytes: 5 %
_CURVE_MARGIN = math.log(1.05)
# number of images that a line of a table of losses names
_NUM_WORST = 3


class Gain(NamedTuple):
    """Differences between two methods, by image."""

    values: dict[str, float]
    tie: float
    """The largest difference that is no difference."""
    sign: int
    """1: more is better, -1: less is."""

    @property
    def mean(self) -> float:
        """Mean over images."""
        return fmean(self.values.values())

    @property
    def num_wins(self) -> int:
        """Number of images on which the first method is better."""
        return sum(self.sign * value > self.tie for value in self.values.values())

    @property
    def losses(self) -> list[str]:
        """Images on which the second method is better, the worst first."""
        values = {image: self.sign * value for image, value in self.values.items()}
        return sorted((image for image, value in values.items() if value < -self.tie), key=values.__getitem__)

    @property
    def interval(self) -> tuple[float, float] | None:
        """Bootstrap 95 % interval of the mean over images, widened as Student's is for few; None: fewer than five."""
        count = len(self.values)
        if count < 5:
            return None
        samples = np.random.default_rng(0).choice(list(self.values.values()), (_NUM_SAMPLES, count)).mean(1)
        factor = float(stats.t.ppf(0.975, count - 1) / stats.norm.ppf(0.975)) * math.sqrt(count / (count - 1))
        low, high = (self.mean + factor * float(end - self.mean) for end in np.percentile(samples, (2.5, 97.5)))
        return low, high


class Comparison(NamedTuple):
    """Two methods whose results are compared, image by image."""

    first: str
    second: str

    def gains(self, rows: Iterable[Row], quantity: str, cases: Sequence[str]) -> dict[tuple[object, ...], Gain]:
        """Return the gains of the first over the second by case, the values of these columns; seeds are averaged."""
        values: dict[tuple[object, ...], dict[str, dict[str, list[float]]]] = {}
        for row in rows:
            if row["method"] in self and not is_missing(row.get(quantity)):
                images = values.setdefault(tuple(row.get(name) for name in cases), {})
                images.setdefault(row["image"], {}).setdefault(row["method"], []).append(row[quantity])
        column = column_of(quantity)
        gains = {}
        for case, images in values.items():
            differences = {
                image: fmean(methods[self.first]) - fmean(methods[self.second])
                for image, methods in images.items()
                if len(methods) == 2
            }
            if differences:
                gains[case] = Gain(differences, column.tie, -1 if column.less_is_better else 1)
        return gains


def differences(
    rows: Sequence[Row], comparisons: Sequence[Comparison], quantities: Sequence[str], cases: Sequence[str]
) -> list[Row]:
    """List paired differences by comparison and case, above zero where the first has more, with their intervals."""
    lines = []
    for comparison in comparisons:
        gains = {quantity: comparison.gains(rows, quantity, cases) for quantity in quantities}
        for case in dict.fromkeys(case for by_case in gains.values() for case in by_case):
            line = {"method": " - ".join(comparison), **dict(zip(cases, case, strict=True))}
            for quantity, by_case in gains.items():
                if gain := by_case.get(case):
                    line |= {quantity: gain.mean, f"{quantity} won": gain.num_wins, f"{quantity} of": len(gain.values)}
                    line |= dict(zip((f"{quantity} low", f"{quantity} high"), gain.interval or (), strict=False))
            lines.append(line)
    return lines


def losses_table(
    rows: Sequence[Row], comparisons: Sequence[Comparison], quantities: Sequence[str], cases: Sequence[str]
) -> str:
    """Count the images on which the first method loses, over all cases, and name the worst."""
    lines = []
    for comparison in comparisons:
        for quantity in quantities:
            by_case = comparison.gains(rows, quantity, cases)
            losses = [(gain, case, image) for case, gain in by_case.items() for image in gain.losses]
            losses.sort(key=lambda loss: -abs(loss[0].values[loss[2]]))
            worst = [
                " ".join([image, *map(_case, cases, case), format_value(quantity, gain.values[image], "+")])
                for gain, case, image in losses[:_NUM_WORST]
            ]
            if worst:
                count = sum(len(gain.values) for gain in by_case.values())
                lines.append([" - ".join(comparison), title(quantity), f"{len(losses)} of {count}", ", ".join(worst)])
    return markdown(["difference", "in", "lost", "worst"], lines) if lines else ""


def _case(name: str, value: Any) -> str:
    return value if isinstance(value, str) else f"({title(name)} = {format_value(name, value)})"


def mean_gain(rows: Sequence[Row], comparison: Comparison, quantity: str, cases: Sequence[str] = ()) -> float:
    """Return the mean gain over all images and cases; NaN: there are no pairs."""
    gains = comparison.gains(rows, quantity, cases).values()
    return fmean([value for gain in gains for value in gain.values.values()] or [math.nan])


def count_wins(rows: Sequence[Row], comparison: Comparison, quantity: str, cases: Sequence[str] = ()) -> str:
    """Say in how many pairs the first method is better."""
    gains = comparison.gains(rows, quantity, cases).values()
    return f"{sum(gain.num_wins for gain in gains)} of {sum(len(gain.values) for gain in gains)}"


def at_equal_bits(
    rows: Sequence[Row], comparison: Comparison, quantities: Sequence[str], cases: Sequence[str]
) -> Iterator[Row]:
    """Yield the second method's quality at the bytes of each file of the first.

    The second method's own files of that image are interpolated by monotone cubics over the logarithm of their bytes;
    more than 5 % outside of them there is no number. The rows' method is "SECOND, equal bits".
    """
    curves: dict[tuple[object, ...], PchipInterpolator] = {}
    files = group_by([row for row in rows if row["method"] == comparison.second], [*cases, "image"])
    for key, group in files.items():
        for quantity in quantities:
            values: dict[float, list[float]] = defaultdict(list)
            for row in group:
                if not is_missing(row.get(quantity)):
                    values[math.log(row["bytes"])].append(row[quantity])
            if len(values) > 1:
                sizes = sorted(values)
                curves[*key, quantity] = PchipInterpolator(sizes, [fmean(values[size]) for size in sizes])
    for row in rows:
        key = (*(row.get(name) for name in cases), row["image"])
        if row["method"] == comparison.first and key in files:
            qualities, size = {}, math.log(row["bytes"])
            for quantity in quantities:
                curve = curves.get((*key, quantity))
                if curve is not None and curve.x[0] - _CURVE_MARGIN <= size <= curve.x[-1] + _CURVE_MARGIN:
                    qualities[quantity] = float(curve(size))
            names = {name: row[name] for name in ("image", "n", "target_bytes", *cases) if name in row}
            yield {**names, "bytes": row["bytes"], "method": f"{comparison.second}, equal bits", **qualities}
