"""What kcgs has over other codecs, in means over images, and the bounds that it is held to."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from kcgs.bench.maps.gains import interval

from .bjontegaard import Delta, delta
from .codecs import AVIF, CODECS, JPEG, WEBP
from .pictures import MAPS, MATCHED, MOST_BYTES, PRECISION, SPEED
from .points import DECODE, FLOAT, KCGS, LABELS, LOSSLESS_WEBP, NO_REGIONS, PLAIN, TUNED, Point

PSNR, EF_PSNR = "psnr", "ef_psnr"
# as tables call them, and their unit
QUALITIES = {
    PSNR: ("PSNR", "dB"),
    EF_PSNR: ("EF-PSNR", "dB"),
    "ms_ssim": ("MS-SSIM", "1"),
    "ef_ssim": ("EF-SSIM", "1"),
}
RIVALS = (*CODECS, NO_REGIONS)
# a smaller difference is neither a win nor a loss
TIE = {"dB": 0.005, "1": 0.0005, "%": 0.05}
MOST_BITS, MOST_SHARE = 48.0, 45.0
MOST_SECONDS = {TUNED: 5.0, PLAIN: 0.5, DECODE: 0.1}


class Pair(NamedTuple):
    """Two files of one picture; ours has no more bytes."""

    ours: Point
    other: Point

    def gain(self, quality: str) -> float:
        """Difference in a quality, above zero where kcgs is better."""
        return float(getattr(self.ours, quality)) - float(getattr(self.other, quality))


class Mean(NamedTuple):
    """Mean over images and its bootstrap 95 % interval."""

    values: Mapping[str, float]  # by image
    mean: float
    low: float
    high: float


class Line(NamedTuple):
    """A line of summary.csv: something about many files."""

    group: str
    against: str
    what: str
    unit: str
    images: int
    mean: float
    low: float
    high: float


class Bound(NamedTuple):
    """A bound, what was measured, and whether it is met."""

    what: str
    bound: str
    measured: str
    met: bool


def mean_of(values: Mapping[str, float]) -> Mean | None:
    """Sum up; images without a value are left out. None: there are none."""
    values = {image: value for image, value in values.items() if not math.isnan(value)}
    if not values:
        return None
    return Mean(values, statistics.fmean(values.values()), *interval(list(values.values())))


def pairs(points: Sequence[Point], rival: str) -> list[Pair]:
    """Pair each matched file of a codec with kcgs' largest that has no more bytes.

    Without regions kcgs was asked for as many bytes as the first file with them, which is what that one meets.
    """
    here = [p for p in points if p.group == MATCHED]
    found = []
    for other in (p for p in here if p.codec == rival):
        ours = [p for p in here if (p.codec, p.image) == (KCGS, other.image)]
        if rival == NO_REGIONS:
            ours = [p for p in ours if p.asked == other.asked]
        else:
            ours = [p for p in ours if p.bytes <= other.bytes]
        if ours:
            found.append(Pair(max(ours, key=lambda p: p.bytes), other))
    return found


def low_enough(pair: Pair) -> bool:
    """Say whether the other codec could go as low as it was asked to."""
    return pair.other.bytes <= pair.other.asked


def gains(found: Sequence[Pair], quality: str) -> dict[str, float]:
    """Differences by image."""
    return {pair.other.image: pair.gain(quality) for pair in found}


def deltas(points: Sequence[Point], group: str, rival: str, quality: str) -> dict[str, Delta]:
    """Compare kcgs' curve with another, image by image; similarities count as dB of what they lack."""
    here = [p for p in points if p.group == group]
    found = {}
    for image in dict.fromkeys(p.image for p in here):
        curves = [
            [(float(p.bytes), _in_db(float(getattr(p, quality)), quality)) for p in here if (p.codec, p.image) == key]
            for key in ((KCGS, image), (rival, image))
        ]
        curves = [[point for point in curve if math.isfinite(point[1])] for curve in curves]
        if min(map(len, curves)) > 1:
            found[image] = delta(*curves)
    return found


def bits_a_gaussian(points: Sequence[Point]) -> list[tuple[Point, Point, float]]:
    """Pair each float scene with its file, and the file's bits for each Gaussian in it, everything included."""
    here = {(p.image, p.asked, p.codec): p for p in points if p.group == PRECISION}
    found = []
    for (image, n, codec), file in here.items():
        if codec == KCGS and (image, n, FLOAT) in here:
            found.append((here[image, n, FLOAT], file, 8 * file.bytes / file.num_gaussians))
    return found


def shares(points: Sequence[Point]) -> dict[str, float]:
    """Bytes of each label map in % of those as lossless WebP."""
    sizes = {(p.image, p.codec): p.bytes for p in points if p.group == MAPS}
    ours = [(image, size) for (image, codec), size in sizes.items() if codec == LABELS]
    return {i: 100 * size / sizes[i, LOSSLESS_WEBP] for i, size in ours if (i, LOSSLESS_WEBP) in sizes}


def bounds(points: Sequence[Point]) -> list[Bound]:
    """Hold what was measured to the bounds."""
    found = []
    for rival, quality, least in (
        *((JPEG, PSNR, 2.5), (JPEG, EF_PSNR, 3.0), (WEBP, PSNR, 0.0), (WEBP, EF_PSNR, 0.0)),
        *(
            (codec, q, least)
            for codec in CODECS
            if codec.startswith(AVIF)
            for q, least in ((PSNR, -0.5), (EF_PSNR, 0.5))
        ),
    ):
        mean = mean_of(gains([p for p in pairs(points, rival) if low_enough(p)], quality))
        if mean is not None:
            what = f"at {MOST_BYTES:,} bytes, mean {QUALITIES[quality][0]} over {rival}, {len(mean.values)} frames"
            found.append(Bound(what, f">= {least:+.2f} dB", f"{mean.mean:+.2f} dB", mean.mean >= least))
    return found + _other_bounds(points)


def _other_bounds(points: Sequence[Point]) -> list[Bound]:
    found = []
    files = bits_a_gaussian(points)
    for n in sorted({scene.asked for scene, _, _ in files}):
        most = max(bits for scene, _, bits in files if scene.asked == n)
        loss = max(scene.psnr - file.psnr for scene, file, _ in files if scene.asked == n)
        what = f"bits a Gaussian at N = {n:,}, the worst frame; most that one loses is {loss:.2f} dB"
        found.append(Bound(what, f"<= {MOST_BITS:.0f}", f"{most:.1f}", most <= MOST_BITS and loss <= 0.15 + 1e-6))
    maps = mean_of(shares(points))
    if maps is not None:
        what = f"bytes of label maps to those as lossless WebP, mean of {len(maps.values)}"
        found.append(Bound(what, f"<= {MOST_SHARE:.0f} %", f"{maps.mean:.1f} %", maps.mean <= MOST_SHARE))
    for p in points:
        if p.group == SPEED:
            took = p.decode_seconds if p.codec == DECODE else p.encode_seconds
            most = MOST_SECONDS[p.codec]
            what = f"seconds, {p.codec}, {p.num_gaussians:,} Gaussians"
            found.append(Bound(what, f"<= {most:g} s", f"{took:.3g} s", took <= most))
    return found


def lines(points: Sequence[Point]) -> list[Line]:
    """Sum all of it up for summary.csv."""
    found: list[Line | None] = []
    for rival in RIVALS:
        for quality, (name, unit) in QUALITIES.items():
            for which, keep in _CHOICES.items():
                mean = mean_of(gains([p for p in pairs(points, rival) if keep(p)], quality))
                found.append(_line(MATCHED, rival, f"{name} gained{which}", unit, mean))
            for group in dict.fromkeys(p.group for p in points if p.group.endswith("curve")):
                by_image = deltas(points, group, rival, quality)
                rates = mean_of({image: d.rate for image, d in by_image.items()})
                found.append(_line(group, rival, f"BD-rate of {name}", "%", rates))
                if unit == "dB":
                    better = mean_of({image: d.quality for image, d in by_image.items()})
                    found.append(_line(group, rival, f"BD-{name}", "dB", better))
    for n in sorted({scene.asked for scene, _, _ in bits_a_gaussian(points)}):
        bits = {scene.image: bits for scene, _, bits in bits_a_gaussian(points) if scene.asked == n}
        found.append(_line(PRECISION, "", f"bits a Gaussian at N = {n}", "bits", mean_of(bits)))
    for folder in ("", *dict.fromkeys(image.split("/")[0] for image in shares(points))):
        share = {image: value for image, value in shares(points).items() if image.startswith(folder)}
        found.append(_line(MAPS, LOSSLESS_WEBP, f"bytes, {folder or 'all'}", "%", mean_of(share)))
    return [line for line in found if line is not None]


_CHOICES: dict[str, Callable[[Pair], bool]] = {
    "": lambda pair: True,
    ", where it can go as low": low_enough,
}


def _line(group: str, against: str, what: str, unit: str, mean: Mean | None) -> Line | None:
    if mean is None:
        return None
    return Line(group, against, what, unit, len(mean.values), mean.mean, mean.low, mean.high)


def _in_db(value: float, quality: str) -> float:
    if QUALITIES[quality][1] == "dB":
        return value
    return -10 * math.log10(1 - value) if value < 1 else math.inf
