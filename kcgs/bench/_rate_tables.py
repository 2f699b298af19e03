"""What kcgs has over other codecs: pairs of files, curves, bounds, and the tables of bench rate."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ._codecs import AVIF, AVIF_PSNR, CODECS, JPEG, WEBP
from ._rate_files import FLOAT, KCGS, LABELS, LOSSLESS_WEBP, MAPS, NO_REGIONS, Point
from .core.statistics import Bound, Delta, Summary, delta, summarize
from .core.tables import count, db, markdown, seconds, signed

MATCHED, DAVIS_CURVE, KODAK_CURVE = "davis8k", "davis-curve", "kodak-curve"
PRECISION, SPEED = "precision", "speed"
TUNED, PLAIN, DECODE = "encode, fine-tuned", "encode", "decode"
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
MOST_BYTES, MOST_BITS, MOST_SHARE = 7_950, 48.0, 45.0
MOST_SECONDS = {TUNED: 5.0, PLAIN: 0.5, DECODE: 0.1}
_LEAST = {JPEG: (2.5, 3.0), WEBP: (0.0, 0.0), AVIF: (-0.5, 0.5), AVIF_PSNR: (-0.5, 0.5)}


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
        return float(getattr(self.ours, quality)) - float(getattr(self.other, quality))


def pairs(points: Sequence[Point], rival: str) -> list[Pair]:
    """Pair each matched file of a codec with kcgs' largest that has no more bytes.

    Without regions kcgs was asked for as many bytes as the first file with them, which is what that one meets.
    """
    matched = [p for p in points if p.group == MATCHED]
    found = []
    for other in (p for p in matched if p.codec == rival):
        ours = [p for p in matched if (p.codec, p.image) == (KCGS, other.image)]
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
        value = float(getattr(p, quality))
        if QUALITIES[quality][1] != "dB":
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


def bounds(points: Sequence[Point]) -> list[Bound]:
    """Hold what was measured to the bounds."""
    found = []
    for rival, bound in _LEAST.items():
        for quality, least in zip((PSNR, EF_PSNR), bound, strict=True):
            gain = gains([pair for pair in pairs(points, rival) if pair.is_low], quality)
            if gain is not None:
                over = f"mean {QUALITIES[quality][0]} over {rival}, {len(gain.values)} frames"
                what, measured = f"at {MOST_BYTES:,} bytes, {over}", f"{gain.mean:+.2f} dB"
                found.append(Bound(what, f">= {least:+.2f} dB", measured, gain.mean >= least))
    files = bits_per_gaussian(points)
    for n in sorted({scene.asked for scene, _, _ in files}):
        most = max(bits for scene, _, bits in files if scene.asked == n)
        loss = max(scene.psnr - file.psnr for scene, file, _ in files if scene.asked == n)
        what = f"bits per Gaussian at N = {n:,}, the worst frame; most that one loses is {loss:.2f} dB"
        found.append(Bound(what, f"<= {MOST_BITS:.0f}", f"{most:.1f}", most <= MOST_BITS and loss <= 0.15 + 1e-6))
    share = summarize(shares(points), TIE["%"])
    if share is not None:
        what = f"bytes of label maps to those as lossless WebP, mean of {len(share.values)}"
        found.append(Bound(what, f"<= {MOST_SHARE:.0f} %", f"{share.mean:.1f} %", share.mean <= MOST_SHARE))
    for p in (p for p in points if p.group == SPEED):
        limit, what = MOST_SECONDS[p.codec], f"seconds, {p.codec}, {p.num_gaussians:,} Gaussians"
        found.append(Bound(what, f"<= {limit:g} s", f"{_took(p):.3g} s", _took(p) <= limit))
    return found


def losses(points: Sequence[Point]) -> str:
    """Name what kcgs loses, worst first in each line."""
    lines = []
    for rival in RIVALS:
        for quality, (name, unit) in QUALITIES.items():
            gain = gains(pairs(points, rival), quality)
            if gain is not None and gain.losses:
                which = ", ".join(f"{i} {_signed(gain.values[i], unit)}" for i in gain.worst[: gain.losses])
                lost = f"{gain.losses} of {len(gain.values)} frames lose"
                lines.append(f"- {MATCHED}, {name} against {rival}: {lost}: {which}")
    for group in curve_groups(points):
        for rival in RIVALS:
            for quality, (name, _) in QUALITIES.items():
                by_image = deltas(points, group, rival, quality)
                above = sorted(((d.rate, i) for i, d in by_image.items() if d.rate > TIE["%"]), reverse=True)
                if above:
                    which = ", ".join(f"{image} {rate:+.0f} %" for rate, image in above)
                    lines.append(f"- {group}, BD-rate of {name} against {rival}: more bits on {which}")
    return "\n".join(lines) or "Nowhere."


def no_overlap(points: Sequence[Point]) -> str:
    """Name the images on which two curves have no quality in common."""
    lines = []
    for group in curve_groups(points):
        for rival in RIVALS:
            apart = []
            for quality, (name, _) in QUALITIES.items():
                images = [i for i, d in deltas(points, group, rival, quality).items() if math.isnan(d.rate)]
                apart += [f"{name} on {', '.join(images)}"] if images else []
            if apart:
                lines.append(f"- {group}, no quality in common with {rival}, so no BD-rate: {'; '.join(apart)}")
    return "\n".join(lines) or "All curves overlap."


def matched_means(points: Sequence[Point]) -> str:
    """Means of what kcgs gains at no more bytes."""
    header = ["against", "frames", "its bytes", "kcgs' bytes"]
    header += [cell for name, _ in QUALITIES.values() for cell in (f"{name} gained", "95 %", "won-lost")]
    header += ["s, encode", "s, decode"]
    lines = []
    for rival in RIVALS:
        found = pairs(points, rival)
        low = [pair for pair in found if pair.is_low]
        for name, group in ((rival, found), (f"{rival}, as low", low if len(low) < len(found) else [])):
            if group:
                lines.append([name, *_pair_cells(group)])
    ours = [p.ours for p in pairs(points, AVIF_PSNR) or pairs(points, AVIF)]
    if ours:
        blank = [""] * (3 * len(QUALITIES))
        lines.append([KCGS, str(len(ours)), "", _mean_bytes(ours), *blank, *_times(ours)])
    return markdown(header, lines)


def each_frame(points: Sequence[Point], rival: str) -> str:
    """Every frame against one codec, the losses first."""
    header = ["frame", "its bytes", "kcgs' bytes", "PSNR", "EF-PSNR", "kcgs' PSNR", "kcgs' EF-PSNR"]
    header += ["PSNR gained", "EF-PSNR gained", "MS-SSIM gained", "EF-SSIM gained", "regions", "Gaussians"]
    header += ["s, encode", "kcgs, s", "s, decode", "kcgs, s"]
    lines = []
    for pair in sorted(pairs(points, rival), key=lambda p: p.gain(PSNR)):
        ours, other = pair
        line = [other.image, count(other.bytes), count(ours.bytes)]
        line += [db(p) for p in (other.psnr, other.ef_psnr, ours.psnr, ours.ef_psnr)]
        line += [_signed(pair.gain(quality), unit) for quality, (_, unit) in QUALITIES.items()]
        line += [str(ours.regions), count(ours.num_gaussians)]
        for field in ("encode_seconds", "decode_seconds"):
            line += [seconds(getattr(point, field)) for point in (other, ours)]
        lines.append(line)
    return markdown(header, lines)


def bd_means(points: Sequence[Point], group: str) -> str:
    """Means of Bjontegaard's differences."""
    header = ["against", "images"]
    header += [cell for name, _ in QUALITIES.values() for cell in (f"BD-rate of {name}, %", "95 %")]
    header += ["BD-PSNR, dB", "95 %", "BD-EF-PSNR, dB", "95 %"]
    lines = []
    for rival in RIVALS:
        found = {quality: deltas(points, group, rival, quality) for quality in QUALITIES}
        line = [rival, str(len(found[PSNR]))]
        for by_image in found.values():
            line += _mean_cells({image: d.rate for image, d in by_image.items()}, "%")
        for quality in (PSNR, EF_PSNR):
            line += _mean_cells({image: d.quality for image, d in found[quality].items()}, "dB")
        lines += [line] if found[PSNR] else []
    return markdown(header, lines)


def bd_each(points: Sequence[Point], group: str) -> str:
    """Bjontegaard's differences of every image, the most lost first."""
    header = ["image", "against", "BD-rate of PSNR, %", "overlap, dB", "BD-PSNR, dB"]
    header += ["BD-rate of EF-PSNR, %", "overlap, dB", "BD-EF-PSNR, dB"]
    lines = []
    for rival in RIVALS:
        found = [deltas(points, group, rival, quality) for quality in (PSNR, EF_PSNR)]
        for image, first in found[0].items():
            line = [image, rival]
            for d in (by_image.get(image) for by_image in found):
                line += ["", "", ""] if d is None else [_signed(d.rate, "%"), f"{d.overlap:.1f}", signed(d.quality)]
            lines.append((math.inf if math.isnan(first.rate) else first.rate, line))
    return markdown(header, [line for _, line in sorted(lines, key=lambda line: -line[0])])


def precision_table(points: Sequence[Point]) -> str:
    """What a Gaussian takes in a file that shows nearly what the fit does, most first."""
    header = ["frame", "N", "PSNR", "file's PSNR", "lost, dB", "EF-PSNR", "file's EF-PSNR", "in the file", "bytes"]
    header += ["bits per Gaussian", "to those of the fit", "setting", "s, compress"]
    lines = []
    for scene, file, bits in sorted(bits_per_gaussian(points), key=lambda line: -line[2]):
        line = [scene.image, count(scene.num_gaussians), db(scene.psnr), db(file.psnr), db(scene.psnr - file.psnr)]
        line += [db(scene.ef_psnr), db(file.ef_psnr), count(file.num_gaussians), count(file.bytes), f"{bits:.1f}"]
        line += [f"{8 * file.bytes / scene.num_gaussians:.1f}", file.setting, seconds(file.encode_seconds)]
        lines.append(line)
    return markdown(header, lines)


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


def speed_table(points: Sequence[Point]) -> str:
    """Seconds of each step."""
    lines = [
        [p.image, count(p.num_gaussians), p.codec, count(p.bytes), f"{1e3 * _took(p):.0f}"]
        for p in points
        if p.group == SPEED
    ]
    return markdown(["frame", "Gaussians", "what", "bytes", "ms, median"], lines)


def dropped(points: Sequence[Point]) -> str:
    """Name the files of kcgs that hold no map though one was given."""
    found = [f"{p.image} at {p.bytes:,} bytes ({p.group})" for p in points if p.codec == KCGS and p.regions == 1]
    return f"{KCGS.capitalize()} left the map out of: {', '.join(found) or 'no file'}."


def curve_groups(points: Sequence[Point]) -> list[str]:
    """Name the groups with curves."""
    return list(dict.fromkeys(p.group for p in points if p.group.endswith("curve")))


def _pair_cells(found: Sequence[Pair]) -> list[str]:
    others = [pair.other for pair in found]
    cells = [str(len(found)), _mean_bytes(others), _mean_bytes([pair.ours for pair in found])]
    for quality, (_, unit) in QUALITIES.items():
        gain = gains(found, quality)
        if gain is None:
            cells += ["", "", ""]
        else:
            cells += [_signed(gain.mean, unit), _spread(gain, unit), f"{gain.wins}-{gain.losses}"]
    return cells + _times(others)


def _mean_bytes(points: Sequence[Point]) -> str:
    return count(statistics.fmean(p.bytes for p in points))


def _times(points: Sequence[Point]) -> list[str]:
    return [seconds(statistics.median(getattr(p, f"{what}_seconds") for p in points)) for what in ("encode", "decode")]


def _took(point: Point) -> float:
    return point.decode_seconds if point.codec == DECODE else point.encode_seconds


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
    if unit == "dB" or math.isnan(value):
        return signed(value)
    return f"{value:+.3f}" if unit == "1" else f"{value:+.1f}"
