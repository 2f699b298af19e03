"""Means by method, differences paired by image with their intervals, and the images on which a method is worse."""

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


class Column(NamedTuple):
    """A column of rows, as tables show it."""

    title: str
    format: str
    tie: float = 0.0
    """The largest difference that is no difference, where methods are compared."""
    less_is_better: bool = False


# other columns have their own name as the title, and three digits
COLUMNS = {
    "n": Column("N", ",.0f"),
    "target_bytes": Column("target bytes", ",.0f"),
    "bytes": Column("bytes", ",.0f", 0.5, less_is_better=True),
    "map_bytes": Column("of these map", ",.0f", 0.5),
    "regions": Column("regions", ".1f"),
    "budget": Column("seconds", ",.0f"),
    "iterations": Column("iterations", ",.0f"),
    "bpp": Column("bits per pixel", ".3f", 0.0005),
    "psnr": Column("PSNR", ".2f", 0.005),
    "ms_ssim": Column("MS-SSIM", ".4f", 0.0001),
    "ef_psnr": Column("EF-PSNR", ".2f", 0.005),
    "ssimulacra2": Column("SSIMULACRA2", ".1f", 0.05),
    "delta_e": Column("deltaE 2000", ".2f", 0.005, less_is_better=True),
    "butteraugli": Column("butteraugli", ".1f", 0.05, less_is_better=True),
    "decoded_psnr": Column("PSNR decoded", ".2f", 0.005),
    "decoded_ef_psnr": Column("EF-PSNR decoded", ".2f", 0.005),
    "core_seconds": Column("seconds of a core", ".1f", 0.05, less_is_better=True),
    "iou": Column("IoU", ".2f", 0.005),
    "good": Column("good", ".0%"),
    "failed": Column("failed", ".0%", less_is_better=True),
    "seconds": Column("seconds", "", less_is_better=True),
    "batch": Column("images in a batch", ",.0f"),
    "images_per_second": Column("images per second", ""),
    "forward_ms": Column("forward, ms", "", less_is_better=True),
    "both_ms": Column("forward and backward, ms", "", less_is_better=True),
    "captured_forward_ms": Column("forward captured, ms", "", less_is_better=True),
    "captured_both_ms": Column("both captured, ms", "", less_is_better=True),
    "flicker": Column("flicker", ".2f", 0.005, less_is_better=True),
    "steep": Column("steep", "", less_is_better=True),
    "beyond [0, 1]": Column("beyond [0, 1]", "", less_is_better=True),
}
# of the bootstrap
_NUM_SAMPLES = 10_000
# in the logarithm of bytes: how far a curve is continued beyond its ends, 5 %
_CURVE_MARGIN = math.log(1.05)
# images that a table of losses names
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
    """Two methods."""

    first: str
    second: str

    def gains(self, rows: Iterable[Row], quantity: str, cases: Sequence[str]) -> dict[tuple[object, ...], Gain]:
        """Return the gains of the first over the second by case, the values of these columns; seeds are averaged."""
        values: dict[tuple[object, ...], dict[str, dict[str, list[float]]]] = {}
        for row in rows:
            if row["method"] in self and not is_missing(row.get(quantity)):
                images = values.setdefault(tuple(row.get(name) for name in cases), {})
                images.setdefault(row["image"], {}).setdefault(row["method"], []).append(row[quantity])
        column = _column(quantity)
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


def is_missing(value: Any) -> bool:
    """True where a row has no number."""
    return not isinstance(value, int | float) or math.isnan(value)


def values_of(rows: Iterable[Row], name: str) -> list[float]:
    """Return the numbers of a column."""
    return [row[name] for row in rows if not is_missing(row.get(name))]


def group_by(rows: Iterable[Row], names: Sequence[str]) -> dict[tuple[object, ...], list[Row]]:
    """Group rows by their values of these columns, in order of appearance."""
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row.get(name) for name in names)].append(row)
    return groups


def title(name: str) -> str:
    """Return the title of a column."""
    return _column(name).title


def format_value(name: str, value: Any, sign: str = "") -> str:
    """Format a value of a column; a text stays, a missing number is empty."""
    if isinstance(value, str):
        return value
    if is_missing(value):
        return ""
    default = ",.0f" if abs(value) >= 100 else ".3g"
    return format(value, sign + (_column(name).format or default))


def _column(name: str) -> Column:
    return COLUMNS.get(name, Column(name.replace("_", " "), ""))


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Lay out a table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [header, ["---"] * len(header), *lines])


def means_table(
    rows: Sequence[Row], names: Sequence[str], along: str, quantities: Sequence[str], sign: str = ""
) -> str:
    """Lay out means, a line for each combination of names, a column for each value along, quantities as "a / b".

    A mean of fewer images than others of its line has their number behind it.
    """
    values: list[Any] = list(group_by(rows, [along])) if along else [()]
    lines = []
    for key, group in group_by(rows, names).items():
        by_value = group_by(group, [along] if along else [])
        cells = [_mean_cells(by_value.get(value, []), quantities, sign) for value in values]
        counts = [len(group_by(by_value.get(value, []), ["image"])) for value in values]
        joined = [
            " / ".join(filter(None, cell)) + (f" ({count})" if 0 < count < max(counts) else "")
            for cell, count in zip(cells, counts, strict=True)
        ]
        joined = joined if along else cells[0]
        lines.append([*map(format_value, names, key), *joined])
    header = [_column_header(along, *value) for value in values] if along else map(title, quantities)
    return markdown([*map(title, names), *header], lines)


def _column_header(name: str, value: Any) -> str:
    return value if isinstance(value, str) else f"{title(name)} = {format_value(name, value)}"


def _mean_cells(rows: Sequence[Row], quantities: Sequence[str], sign: str) -> list[str]:
    return [format_value(name, fmean(values), sign) if (values := values_of(rows, name)) else "" for name in quantities]


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


def join_tables(first: str, second: str) -> str:
    """Put the lines of a table under those of another with the same columns; either may be empty."""
    return "\n".join([first, *second.splitlines()[2:]]) if first else second


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
