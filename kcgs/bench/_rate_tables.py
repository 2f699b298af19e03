"""What kcgs has over other codecs: pairs of files, curves, and the tables of bench rate."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from ._codecs import AVIF, CODECS
from ._rate_files import FLOAT, KCGS, LABELS, LOSSLESS_WEBP, MAPS, NO_REGIONS, VISUAL, Point
from .core.statistics import Delta, Summary, delta, summarize
from .core.tables import count, db, markdown, seconds, signed, table

MATCHED, DAVIS_CURVE, KODAK_CURVE = "davis8k", "davis-curve", "kodak-curve"
PRECISION = "precision"
PSNR, EF_PSNR = "psnr", "ef_psnr"
# as tables call them, and their unit
QUALITIES = {PSNR: ("PSNR", "dB"), EF_PSNR: ("EF-PSNR", "dB"), "ms_ssim": ("MS-SSIM", "1"), "ef_ssim": ("EF-SSIM", "1")}
QUALITIES |= {"ssimulacra2": ("SSIMULACRA2", "points"), "butteraugli": ("butteraugli", "norm")}
RIVALS = (*CODECS, NO_REGIONS)
# whose files meet which others at the same bytes
_CONTESTS = (*((KCGS, rival) for rival in RIVALS), (VISUAL, AVIF))
# a smaller difference is neither a win nor a loss
TIE = {"dB": 0.005, "1": 0.0005, "%": 0.05, "points": 0.05, "norm": 0.005}
MOST_BYTES = 7_950


class Pair(NamedTuple):
    """Two files of one image; ours has no more bytes."""

    ours: Point
    other: Point

    @property
    def is_low(self) -> bool:
        """Whether the other codec could go as low as it was asked to."""
        return self.other.bytes <= self.other.asked

    def gain(self, quality: str) -> float:
        """Difference in a quality, above zero where kcgs is better."""
        return score(self.ours, quality) - score(self.other, quality)


def score(point: Point, quality: str) -> float:
    """Return a quality, higher where it is better."""
    value = float(getattr(point, quality))
    return -value if QUALITIES[quality][1] == "norm" else value


def qualities(points: Sequence[Point]) -> list[str]:
    """Name those that are measured: without a program or a package some are not."""
    return [name for name in QUALITIES if not all(math.isnan(getattr(p, name)) for p in points)]


def pairs(points: Sequence[Point], rival: str, codec: str = KCGS) -> list[Pair]:
    """Pair each matched file of a rival with the largest of ours that has no more bytes.

    Without regions kcgs was asked for as many bytes as the first file with them, which is what that one meets.
    """
    matched = [p for p in points if p.group == MATCHED]
    found = []
    for other in (p for p in matched if p.codec == rival):
        ours = [p for p in matched if (p.codec, p.image) == (codec, other.image)]
        if rival == NO_REGIONS:
            ours = [p for p in ours if p.asked == other.asked]
        else:
            ours = [p for p in ours if p.bytes <= other.bytes]
        if ours:
            found.append(Pair(max(ours, key=lambda p: p.bytes), other))
    return found


def gains(found: Sequence[Pair], quality: str) -> Summary | None:
    """Differences by image."""
    return summarize({pair.other.image: pair.gain(quality) for pair in found}, TIE[QUALITIES[quality][1]])


def deltas(points: Sequence[Point], group: str, rival: str, quality: str) -> dict[str, Delta]:
    """Compare kcgs' curve with another, image by image; similarities count as dB of what they lack."""
    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for p in (p for p in points if p.group == group):
        value = score(p, quality)
        if QUALITIES[quality][1] == "1":
            value = -10 * math.log10(1 - value) if value < 1 else math.inf
        if math.isfinite(value):
            curves.setdefault((p.codec, p.image), []).append((float(p.bytes), value))
    ours = {image: curve for (codec, image), curve in curves.items() if codec == KCGS}
    both = {image: (curve, curves.get((rival, image), [])) for image, curve in ours.items()}
    return {image: delta(*pair) for image, pair in both.items() if min(map(len, pair)) > 1}


def bits_per_gaussian(points: Sequence[Point]) -> list[tuple[Point, Point, float]]:
    """Pair each float scene with its file, and the file's bits for each Gaussian in it, everything included."""
    files = {(p.image, p.asked, p.codec): p for p in points if p.group == PRECISION}
    return [
        (files[image, n, FLOAT], file, 8 * file.bytes / file.num_gaussians)
        for (image, n, codec), file in files.items()
        if codec == KCGS and (image, n, FLOAT) in files
    ]


def shares(points: Sequence[Point]) -> dict[str, float]:
    """Bytes of each label map in % of those as lossless WebP."""
    sizes = {(p.image, p.codec): p.bytes for p in points if p.group == MAPS}
    ours = [(image, size) for (image, codec), size in sizes.items() if codec == LABELS]
    return {i: 100 * size / sizes[i, LOSSLESS_WEBP] for i, size in ours if (i, LOSSLESS_WEBP) in sizes}


def losses(points: Sequence[Point]) -> str:
    """Name what kcgs loses, worst first in each line."""
    lines = []
    for codec, rival in _CONTESTS:
        for quality, (name, unit) in QUALITIES.items():
            gain = gains(pairs(points, rival, codec), quality)
            if gain is not None and gain.losses:
                which = ", ".join(f"{i} {_signed(gain.values[i], unit)}" for i in gain.worst[: gain.losses])
                lost = f"{gain.losses} of {len(gain.values)} frames lose"
                whose = "" if codec == KCGS else f"{codec}, "
                lines.append(f"- {MATCHED}, {whose}{name} against {rival}: {lost}: {which}")
    for group in curve_groups(points):
        for rival in RIVALS:
            for quality, (name, _) in QUALITIES.items():
                by_image = deltas(points, group, rival, quality)
                above = sorted(((d.rate, i) for i, d in by_image.items() if d.rate > TIE["%"]), reverse=True)
                if above:
                    which = ", ".join(f"{image} {rate:+.0f} %" for rate, image in above)
                    lines.append(f"- {group}, BD-rate of {name} against {rival}: more bits on {which}")
    return "\n".join(lines) or "Nowhere."


def matched_means(points: Sequence[Point]) -> str:
    """Means of what kcgs gains at no more bytes."""
    header = ["against", "frames", "its bytes", "kcgs' bytes"]
    measured = qualities(points)
    header += [cell for name in measured for cell in (f"{QUALITIES[name][0]} gained", "95 %", "won-lost")]
    lines = []
    for codec, rival in _CONTESTS:
        found, name = pairs(points, rival, codec), rival if codec == KCGS else f"{codec} against {rival}"
        low = [pair for pair in found if pair.is_low]
        for title, group in ((name, found), (f"{name}, as low", low if len(low) < len(found) else [])):
            if group:
                lines.append([title, *_pair_cells(group, measured)])
    return markdown([*header, "s, encode", "s, decode", "kcgs, s, encode", "kcgs, s, decode"], lines)


def bd_means(points: Sequence[Point], group: str) -> str:
    """Means of Bjontegaard's differences."""
    header = ["against", "images"]
    measured = qualities(points)
    header += [cell for name in measured for cell in (f"BD-rate of {QUALITIES[name][0]}, %", "95 %")]
    header += ["BD-PSNR, dB", "95 %", "BD-EF-PSNR, dB", "95 %"]
    lines = []
    for rival in RIVALS:
        found = {quality: deltas(points, group, rival, quality) for quality in measured}
        line = [rival, str(len(found[PSNR]))]
        for by_image in found.values():
            line += _mean_cells({image: d.rate for image, d in by_image.items()}, "%")
        for quality in (PSNR, EF_PSNR):
            line += _mean_cells({image: d.quality for image, d in found[quality].items()}, "dB")
        lines += [line] if found[PSNR] else []
    return markdown(header, lines)


def precision_table(points: Sequence[Point]) -> str:
    """What a Gaussian takes in a file that shows nearly what the fit does, most first."""
    columns: dict[str, Callable[[tuple[Point, Point, float]], str]] = {
        "frame": lambda line: line[0].image,
        "N": lambda line: count(line[0].num_gaussians),
        "in the file": lambda line: count(line[1].num_gaussians),
        "bytes": lambda line: count(line[1].bytes),
        "bits per Gaussian": lambda line: f"{line[2]:.1f}",
        "PSNR": lambda line: db(line[0].psnr),
        "lost, dB": lambda line: db(line[0].psnr - line[1].psnr),
        "EF-PSNR": lambda line: db(line[0].ef_psnr),
        "lost there, dB": lambda line: db(line[0].ef_psnr - line[1].ef_psnr),
        "s, compress": lambda line: seconds(line[1].encode_seconds),
    }
    return table(columns, sorted(bits_per_gaussian(points), key=lambda line: -line[2]))


def maps_table(points: Sequence[Point]) -> str:
    """What label maps take, by folder."""
    share, lines = shares(points), []
    for folder in dict.fromkeys(image.split("/")[0] for image in share):
        found = summarize({i: value for i, value in share.items() if i.split("/")[0] == folder}, TIE["%"])
        assert found is not None
        of_folder = [p for p in points if p.group == MAPS and p.image in found.values]
        line, worst = [folder, str(found.asked)], found.worst[-1]
        line += [_mean_bytes([p for p in of_folder if p.codec == codec]) for codec in (LOSSLESS_WEBP, LABELS)]
        line += [f"{found.mean:.1f} %", f"{found.low:.1f} to {found.high:.1f} %", f"{worst} {share[worst]:.1f} %"]
        lines.append(line)
    header = ["maps", "how many", f"bytes, {LOSSLESS_WEBP}", f"bytes, {LABELS}", "share, mean", "95 %", "worst"]
    return markdown(header, lines)


def curve_groups(points: Sequence[Point]) -> list[str]:
    """Name the groups with curves."""
    return list(dict.fromkeys(p.group for p in points if p.group.endswith("curve")))


def _pair_cells(found: Sequence[Pair], measured: Sequence[str]) -> list[str]:
    others = [pair.other for pair in found]
    cells = [str(len(found)), _mean_bytes(others), _mean_bytes([pair.ours for pair in found])]
    for quality in measured:
        gain, unit = gains(found, quality), QUALITIES[quality][1]
        if gain is None:
            cells += ["", "", ""]
        else:
            cells += [_signed(gain.mean, unit), _spread(gain, unit), f"{gain.wins}-{gain.losses}"]
    return [*cells, *_times(others), *_times([pair.ours for pair in found])]


def _mean_bytes(points: Sequence[Point]) -> str:
    return count(statistics.fmean(p.bytes for p in points))


def _times(points: Sequence[Point]) -> list[str]:
    return [seconds(statistics.median(getattr(p, f"{what}_seconds") for p in points)) for what in ("encode", "decode")]


def _mean_cells(values: Mapping[str, float], unit: str) -> list[str]:
    found = summarize(values, TIE[unit])
    if found is None:
        return ["", ""]
    of = "" if found.is_complete else f" (of {len(found.values)})"
    return [_signed(found.mean, unit) + of, _spread(found, unit)]


def _spread(found: Summary, unit: str) -> str:
    """Write an interval; one image has none."""
    return f"{_signed(found.low, unit)} to {_signed(found.high, unit)}" if len(found.values) > 1 else ""


def _signed(value: float, unit: str) -> str:
    if unit in ("dB", "norm") or math.isnan(value):
        return signed(value)
    return f"{value:+.3f}" if unit == "1" else f"{value:+.1f}"
