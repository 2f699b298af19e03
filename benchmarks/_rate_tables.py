"""What kcgs has over other codecs: pairs of files, curves, and the tables of bench rate."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import NamedTuple

from ._codecs import AVIF, AVIF_FAST, CODECS
from ._rate_files import FLOAT, KCGS, LABELS, LOSSLESS_WEBP, MAPS, MS_SSIM, NO_REGIONS, Point
from .core.statistics import Delta, Summary, delta, summarize
from .core.tables import count, db, markdown, seconds, signed, similarity, table

MATCHED, DAVIS_CURVE, KODAK = "davis8k", "davis-curve", "kodak"
PRECISION = "precision"
PSNR, EF_PSNR = "psnr", "ef_psnr"
# as tables call them, and their unit
QUALITIES = {PSNR: ("PSNR", "dB"), EF_PSNR: ("EF-PSNR", "dB"), "ms_ssim": ("MS-SSIM", "1"), "ef_ssim": ("EF-SSIM", "1")}
QUALITIES |= {"ssimulacra2": ("SSIMULACRA2", "points"), "butteraugli": ("butteraugli", "norm")}
RIVALS = (*CODECS, NO_REGIONS)
# whose files meet which others at the same bytes
_CONTESTS = (*((KCGS, rival) for rival in RIVALS), (MS_SSIM, AVIF))
# a smaller difference is neither a win nor a loss
TIE = {"dB": 0.005, "1": 0.0005, "%": 0.05, "points": 0.05, "norm": 0.005}
MOST_BYTES = 7_950
# of Kodak's photos, all of as many pixels: bits per pixel by bytes
RATES = {math.floor(rate * 512 * 768 / 8): rate for rate in (0.08, 0.15, 0.3, 0.5, 0.8)}
KODAK_CODECS = (NO_REGIONS, AVIF_FAST, KCGS)
# mean PSNR over all 24 photos of other codecs, read off what they printed
PRINTED = {
    "VTM": {0.08: 27.55, 0.1: 28.17, 0.15: 29.49, 0.2: 30.49, 0.3: 32.08, 0.5: 34.37},
    "C3": {0.08: 27.06, 0.1: 27.75, 0.15: 29.05, 0.2: 30.05, 0.3: 31.71, 0.5: 34.22},
    "BPG": {0.08: 26.68, 0.1: 27.29, 0.15: 28.52, 0.2: 29.48, 0.3: 31.01, 0.5: 33.31},
    "RECOMBINER": {0.08: 26.37, 0.1: 26.96, 0.15: 28.09, 0.2: 28.97, 0.3: 30.27, 0.5: 32.04},
    "JPEG 2000": {0.15: 26.94},
    "GaussianImage++": {0.15: 25.3},
    "COIN++": {0.15: 25.14},
    "Cool-chic 5": {0.0839: 27.44, 0.2186: 30.86, 0.4819: 34.52},
}
_PRINTED_TEXT = """Mean PSNR. In parentheses: over how many photos. The data have {} of Kodak's 24 photos. What other
codecs printed is over all 24, so means of these and of those cannot be compared directly: photos differ by more than
codecs do. Only lines of the same photos can, the measured ones. Cool-chic 5 printed its own rates."""
# of one pair: 5 for the exponent, 6 for the power of two, 3 for the colours; of one pixel: 30 for the splines
_PAIR_PRODUCTS, _PIXEL_PRODUCTS = 14, 30
_MEANS = ("bpp", PSNR, "ms_ssim", "ssimulacra2", "pairs_per_pixel")


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


def deltas(points: Sequence[Point], group: str, rival: str, quality: str, codec: str = KCGS) -> dict[str, Delta]:
    """Compare kcgs' curve with another, image by image; similarities count as dB of what they lack."""
    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for p in (p for p in points if p.group == group and p.codec in (codec, rival)):
        value = score(p, quality)
        if QUALITIES[quality][1] == "1":
            value = -10 * math.log10(1 - value) if value < 1 else math.inf
        if math.isfinite(value):
            curves.setdefault((p.codec, p.image), []).append((float(p.bytes), value))
    ours = {image: curve for (whose, image), curve in curves.items() if whose == codec}
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
    for group, ours in ((DAVIS_CURVE, KCGS), (KODAK, NO_REGIONS)):
        for rival in (rival for rival in RIVALS if rival != ours):
            for quality, (name, _) in QUALITIES.items():
                by_image = deltas(points, group, rival, quality, ours)
                above = sorted(((d.rate, i) for i, d in by_image.items() if d.rate > TIE["%"]), reverse=True)
                if above:
                    which = ", ".join(f"{image} {rate:+.0f} %" for rate, image in above)
                    whose = "" if ours == KCGS else f"{ours}, "
                    lines.append(f"- {group}, {whose}BD-rate of {name} against {rival}: more bits on {which}")
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


def kodak(points: Sequence[Point]) -> str:
    """All of Kodak."""
    text = _PRINTED_TEXT.format(len({p.image for p in points if p.group == KODAK}))
    parts = [kodak_means(points), text, printed_means(points), f"`{NO_REGIONS}` against the others, photo by photo:"]
    return "\n\n".join([*parts, bd_means(points, KODAK, NO_REGIONS)])


def kodak_means(points: Sequence[Point]) -> str:
    """Means over photos by rate, of what was measured."""
    header = ["bpp asked", "codec", "photos", "bpp", "PSNR", "MS-SSIM", "SSIMULACRA2", "gained on them"]
    lines = []
    for most, codec in product(RATES, KODAK_CODECS):
        of_rate = [p for p in points if (p.group, p.asked) == (KODAK, most)]
        found, first = ([p for p in of_rate if p.codec == name] for name in (codec, NO_REGIONS))
        if not found:
            continue
        mean = {name: statistics.fmean(getattr(p, name) for p in found) for name in _MEANS}
        other = {p.image: p.psnr for p in found}
        gained = [p.psnr - other[p.image] for p in first if codec != NO_REGIONS and p.image in other]
        eye = "" if math.isnan(mean["ssimulacra2"]) else f"{mean['ssimulacra2']:.1f}"
        work = "" if codec == AVIF_FAST else count(_PAIR_PRODUCTS * mean["pairs_per_pixel"] + _PIXEL_PRODUCTS)
        line = [f"{RATES[most]:g}", codec, str(len(found)), f"{mean['bpp']:.4f}", db(mean["psnr"])]
        line += [similarity(mean["ms_ssim"]), eye, signed(statistics.fmean(gained)) if gained else ""]
        lines.append([*line, *_times(found), work])
    return markdown([*header, "s, encode", "s, decode", "products per pixel"], lines)


def printed_means(points: Sequence[Point]) -> str:
    """Mean PSNR by rate beside what other codecs printed; how many photos where they are not all 24."""
    rates, lines = sorted({*RATES.values(), *(rate for line in PRINTED.values() for rate in line)}), []
    for codec in KODAK_CODECS:
        cells = []
        for rate in rates:
            found = [p.psnr for p in points if (p.group, p.codec, RATES.get(p.asked)) == (KODAK, codec, rate)]
            cells.append(f"{statistics.fmean(found):.2f} ({len(found)})" if found else "")
        lines += [[f"{codec}, measured", *cells]] if any(cells) else []
    lines += [
        [f"{name}, as printed, all 24 photos", *(db(of.get(r, math.nan)) for r in rates)]
        for name, of in PRINTED.items()
    ]
    return markdown(["bpp", *(f"{rate:g}" for rate in rates)], lines)


def bd_means(points: Sequence[Point], group: str, codec: str = KCGS) -> str:
    """Means of Bjontegaard's differences."""
    header = ["against", "images"]
    measured = qualities(points)
    header += [cell for name in measured for cell in (f"BD-rate of {QUALITIES[name][0]}, %", "95 %")]
    header += ["BD-PSNR, dB", "95 %", "BD-EF-PSNR, dB", "95 %"]
    lines = []
    for rival in (rival for rival in RIVALS if rival != codec):
        found = {quality: deltas(points, group, rival, quality, codec) for quality in measured}
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
