"""Rows beside each other: means, differences that are paired by image, and where a method loses."""

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

# how columns are called and written, and the least difference that counts; the rest has three digits
FORMATS: dict[str, tuple[str, str, float]] = {
    "n": ("N", ",.0f", 0),
    "asked": ("bytes asked", ",.0f", 0),
    "bytes": ("bytes", ",.0f", 0.5),
    "map_bytes": ("of these map", ",.0f", 0.5),
    "regions": ("regions", ".1f", 0),
    "iterations": ("iterations", ",.0f", 0),
    "bpp": ("bits per pixel", ".3f", 0.0005),
    "psnr": ("PSNR", ".2f", 0.005),
    "ms_ssim": ("MS-SSIM", ".4f", 0.0001),
    "ef_psnr": ("EF-PSNR", ".2f", 0.005),
    "ssimulacra2": ("SSIMULACRA2", ".1f", 0.05),
    "decoded_psnr": ("PSNR decoded", ".2f", 0.005),
    "decoded_ef_psnr": ("EF-PSNR decoded", ".2f", 0.005),
    "core_seconds": ("core s", ".1f", 0.05),
}
# less is better
_LESS = ("bytes", "steep", "beyond [0, 1]")
_SAMPLES = 10_000
_MARGIN = math.log(1.05)
_WORST = 5  # images that a table of losses names


class Gain(NamedTuple):
    """Differences between two methods, by image."""

    values: dict[str, float]
    tie: float  # the least difference that counts
    sign: int  # 1: more is better, -1: less is

    @property
    def mean(self) -> float:
        """Mean over images."""
        return fmean(self.values.values())

    @property
    def won(self) -> int:
        """Images on which the first is better."""
        return sum(self.sign * value > self.tie for value in self.values.values())

    @property
    def lost(self) -> list[str]:
        """Images on which the second is better, the worst first."""
        behind = {image: self.sign * value for image, value in self.values.items() if self.sign * value < -self.tie}
        return sorted(behind, key=behind.__getitem__)

    @property
    def interval(self) -> tuple[float, float] | None:
        """Bootstrap 95 % interval of the mean over images, widened as Student's is for few; None: fewer than five."""
        count = len(self.values)
        if count < 5:
            return None
        samples = np.random.default_rng(0).choice(list(self.values.values()), (_SAMPLES, count)).mean(1)
        wider = float(stats.t.ppf(0.975, count - 1) / stats.norm.ppf(0.975)) * math.sqrt(count / (count - 1))
        low, high = (self.mean + wider * float(end - self.mean) for end in np.percentile(samples, (2.5, 97.5)))
        return low, high


class Contest(NamedTuple):
    """Two methods."""

    ours: str
    other: str

    def gains(self, rows: Iterable[Row], quantity: str, cases: Sequence[str]) -> dict[tuple[object, ...], Gain]:
        """Return what the first has over the second in each case, a combination of columns, averaged over seeds."""
        values: dict[tuple[object, ...], dict[str, dict[str, list[float]]]] = {}
        for row in rows:
            if row["method"] in self and not missing(row.get(quantity)):
                case = values.setdefault(tuple(row.get(name) for name in cases), {})
                case.setdefault(row["image"], {}).setdefault(row["method"], []).append(row[quantity])
        tie, sign = FORMATS.get(quantity, ("", "", 0.0))[2], -1 if quantity in _LESS else 1
        pairs = {
            case: {image: fmean(of[self.ours]) - fmean(of[self.other]) for image, of in images.items() if len(of) == 2}
            for case, images in values.items()
        }
        return {case: Gain(by_image, tie, sign) for case, by_image in pairs.items() if by_image}


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Lay out a table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [header, ["---"] * len(header), *lines])


def title(name: str) -> str:
    """Say what readers call a column."""
    return FORMATS[name][0] if name in FORMATS else name.replace("_", " ")


def write(name: str, value: Any, sign: str = "") -> str:
    """Write a number as its column is written, or a text."""
    if isinstance(value, str):
        return value
    if missing(value):
        return ""
    default = ",.0f" if abs(value) >= 100 else ".3g"
    return format(value, sign + (FORMATS[name][1] if name in FORMATS else default))


def grouped(rows: Iterable[Row], names: Sequence[str]) -> dict[tuple[object, ...], list[Row]]:
    """Group rows by what they have under these names, in order of appearance."""
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row.get(name) for name in names)].append(row)
    return groups


def means(rows: Sequence[Row], names: Sequence[str], columns: Sequence[str]) -> str:
    """Lay out the means of columns, a line for each combination of names, with the number of images."""
    lines, count = [], [] if "image" in names else ["images"]
    for key, group in grouped(rows, names).items():
        numbers = {name: column(group, name) for name in columns}
        line = [*map(write, names, key), *(str(len(grouped(group, ["image"]))) for _ in count)]
        lines.append(line + [write(name, fmean(values)) if values else "" for name, values in numbers.items()])
    return markdown([*map(title, names), *count, *map(title, columns)], lines)


def differences(
    rows: Sequence[Row], contests: Sequence[Contest], quantities: Sequence[str], cases: Sequence[str]
) -> str:
    """Lay out paired differences, a line for each contest and case, above zero where the first is better."""
    lines = []
    for contest in contests:
        found = [contest.gains(rows, quantity, cases) for quantity in quantities]
        for case in dict.fromkeys(case for gains in found for case in gains):
            line = [" - ".join(contest), *map(write, cases, case)]
            for quantity, gains in zip(quantities, found, strict=True):
                line += _gain_cells(quantity, gains[case]) if case in gains else [""] * 3
            lines.append(line)
    header = [cell for quantity in quantities for cell in (title(quantity), "95 %", "won-lost")]
    return markdown(["difference", *map(title, cases), *header], lines)


def _gain_cells(quantity: str, gain: Gain) -> list[str]:
    interval = " to ".join(write(quantity, end, "+") for end in gain.interval or ())
    return [write(quantity, gain.mean, "+"), interval, f"{gain.won}-{len(gain.lost)}"]


def losses(rows: Sequence[Row], contests: Sequence[Contest], quantities: Sequence[str], cases: Sequence[str]) -> str:
    """Lay out where a method is below the other, the worst images first."""
    lines = []
    for contest, quantity in ((contest, quantity) for contest in contests for quantity in quantities):
        for case, gain in contest.gains(rows, quantity, cases).items():
            if gain.lost:
                worst = ", ".join(f"{image} {write(quantity, gain.values[image], '+')}" for image in gain.lost[:_WORST])
                lost = f"{len(gain.lost)} of {len(gain.values)}"
                lines.append([" - ".join(contest), *map(write, cases, case), title(quantity), lost, worst])
    return markdown(["difference", *map(title, cases), "in", "lost", "worst"], lines) if lines else ""


def answer(rows: Sequence[Row], contest: Contest, quantities: Sequence[str], cases: Sequence[str]) -> str:
    """Say in a sentence what the first method has over the second, over all cases."""
    parts = []
    for quantity in quantities:
        gains = list(contest.gains(rows, quantity, cases).values())
        if gains:
            won, count = sum(gain.won for gain in gains), sum(len(gain.values) for gain in gains)
            mean = write(quantity, fmean(value for gain in gains for value in gain.values.values()), "+")
            parts.append(f"{title(quantity)} {mean} on average, better in {won} of {count} pairs")
    return f"`{contest.ours}` beside `{contest.other}`: {'; '.join(parts)}." if parts else ""


def at_equal_bits(
    rows: Sequence[Row], contest: Contest, quantities: Sequence[str], cases: Sequence[str]
) -> Iterator[Row]:
    """Yield the other method's quality at the bytes of each file of the first.

    Its own files of that image are interpolated by monotone cubics over the logarithm of their bytes; more than 5 %
    outside of them there is no number. The method is called "OTHER, equal bits".
    """
    curves: dict[tuple[object, ...], PchipInterpolator] = {}
    files = grouped([row for row in rows if row["method"] == contest.other], [*cases, "image"])
    for key, group in files.items():
        for quantity in quantities:
            values: dict[float, list[float]] = defaultdict(list)
            for row in group:
                if not missing(row.get(quantity)):
                    values[math.log(row["bytes"])].append(row[quantity])
            if len(values) > 1:
                sizes = sorted(values)
                curves[*key, quantity] = PchipInterpolator(sizes, [fmean(values[size]) for size in sizes])
    for row in rows:
        key = (*(row.get(name) for name in cases), row["image"])
        if row["method"] == contest.ours and key in files:
            known, size = {}, math.log(row["bytes"])
            for quantity in quantities:
                curve = curves.get((*key, quantity))
                if curve is not None and curve.x[0] - _MARGIN <= size <= curve.x[-1] + _MARGIN:
                    known[quantity] = float(curve(size))
            names = {name: row[name] for name in ("image", "n", "asked", *cases) if name in row}
            yield {**names, "bytes": row["bytes"], "method": f"{contest.other}, equal bits", **known}


def missing(value: Any) -> bool:
    """Whether a row has no number here."""
    return not isinstance(value, int | float) or math.isnan(value)


def column(rows: Iterable[Row], name: str) -> list[float]:
    """Return the numbers that rows have under a name."""
    return [row[name] for row in rows if not missing(row.get(name))]
