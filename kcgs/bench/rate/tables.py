"""The report's tables."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

from kcgs.bench.cells import count, db, markdown, seconds, signed

from .codecs import AVIF, AVIF_PSNR, CODECS
from .gains import (
    EF_PSNR,
    PSNR,
    QUALITIES,
    RIVALS,
    TIE,
    Mean,
    Pair,
    bits_a_gaussian,
    bounds,
    deltas,
    gains,
    low_enough,
    mean_of,
    pairs,
    shares,
)
from .pictures import MAPS, MATCHED, SPEED
from .points import DECODE, KCGS, LABELS, LOSSLESS_WEBP, NO_REGIONS, Point


def losses(points: Sequence[Point]) -> str:
    """Name what kcgs loses, worst first in each line."""
    lines = []
    for rival in RIVALS:
        found = pairs(points, rival)
        for quality, (name, unit) in QUALITIES.items():
            below = sorted((v, i) for i, v in gains(found, quality).items() if v < -TIE[unit])
            if below:
                which = ", ".join(f"{image} {_signed(value, unit)}" for value, image in below)
                lines.append(f"- {MATCHED}, {name} against {rival}: {len(below)} of {len(found)} frames lose: {which}")
    for group in _curve_groups(points):
        for rival in RIVALS:
            for quality, (name, _) in QUALITIES.items():
                by_image = deltas(points, group, rival, quality)
                above = sorted(((d.rate, i) for i, d in by_image.items() if d.rate > TIE["%"]), reverse=True)
                if above:
                    which = ", ".join(f"{image} {rate:+.0f} %" for rate, image in above)
                    lines.append(f"- {group}, BD-rate of {name} against {rival}: more bits on {which}")
    return "\n".join(lines) or "Nowhere."


def no_overlap(points: Sequence[Point]) -> str:
    """Name the pictures on which two curves have no quality in common."""
    lines = []
    for group in _curve_groups(points):
        for rival in RIVALS:
            apart = []
            for quality, (name, _) in QUALITIES.items():
                images = [i for i, d in deltas(points, group, rival, quality).items() if math.isnan(d.rate)]
                if images:
                    apart.append(f"{name} on {', '.join(images)}")
            if apart:
                lines.append(f"- {group}, no quality in common with {rival}, so no BD-rate: {'; '.join(apart)}")
    return "\n".join(lines) or "All curves overlap."


def bounds_table(points: Sequence[Point]) -> str:
    """Say of every bound what was measured and whether it is met, those that are not first."""
    found = sorted(bounds(points), key=lambda bound: bound.met)
    return markdown(
        ["", "bound", "measured", "met"], [[b.what, b.bound, b.measured, "yes" if b.met else "NO"] for b in found]
    )


def matched_means(points: Sequence[Point]) -> str:
    """Means of what kcgs gains at no more bytes."""
    header = ["against", "frames", "its bytes", "kcgs' bytes"]
    header += [cell for name, _ in QUALITIES.values() for cell in (f"{name} gained", "95 %", "won-lost")]
    header += ["s, encode", "s, decode"]
    lines = []
    for rival in RIVALS:
        found = pairs(points, rival)
        for which, some in (("", found), (", as low", [p for p in found if low_enough(p)])):
            if some and (not which or len(some) < len(found)):
                lines.append([rival + which, *_pair_cells(some)])
    ours = [p.ours for p in pairs(points, AVIF_PSNR) or pairs(points, AVIF)]
    if ours:
        blank = [""] * (3 * len(QUALITIES))
        sizes = count(statistics.fmean(p.bytes for p in ours))
        lines.append([KCGS, str(len(ours)), "", sizes, *blank, *_times(ours)])
    return markdown(header, lines)


def _pair_cells(found: Sequence[Pair]) -> list[str]:
    cells = [str(len(found)), count(statistics.fmean(p.other.bytes for p in found))]
    cells.append(count(statistics.fmean(p.ours.bytes for p in found)))
    for quality, (_, unit) in QUALITIES.items():
        mean = mean_of(gains(found, quality))
        if mean is None:
            cells += ["", "", ""]
            continue
        won = sum(v > TIE[unit] for v in mean.values.values())
        lost = sum(v < -TIE[unit] for v in mean.values.values())
        cells += [_signed(mean.mean, unit), _spread(mean, unit), f"{won}-{lost}"]
    return cells + _times([p.other for p in found])


def _times(points: Sequence[Point]) -> list[str]:
    return [seconds(statistics.median(getattr(p, f"{what}_seconds") for p in points)) for what in ("encode", "decode")]


def each_frame(points: Sequence[Point], rival: str) -> str:
    """Every frame against one codec, the losses first."""
    header = ["frame", "its bytes", "kcgs' bytes", "PSNR", "EF-PSNR", "kcgs' PSNR", "kcgs' EF-PSNR"]
    header += ["PSNR gained", "EF-PSNR gained", "MS-SSIM gained", "EF-SSIM gained", "regions", "Gaussians"]
    header += ["s, encode", "kcgs, s", "s, decode", "kcgs, s"]
    lines = []
    for ours, other in sorted(pairs(points, rival), key=lambda p: p.gain(PSNR)):
        pair = Pair(ours, other)
        line = [other.image, count(other.bytes), count(ours.bytes)]
        line += [db(p) for p in (other.psnr, other.ef_psnr, ours.psnr, ours.ef_psnr)]
        line += [_signed(pair.gain(quality), unit) for quality, (_, unit) in QUALITIES.items()]
        line += [str(ours.regions), count(ours.num_gaussians)]
        line += [seconds(s) for s in (other.encode_seconds, ours.encode_seconds)]
        line += [seconds(s) for s in (other.decode_seconds, ours.decode_seconds)]
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
        if found[PSNR]:
            lines.append(line)
    return markdown(header, lines)


def _mean_cells(values: dict[str, float], unit: str) -> list[str]:
    mean = mean_of(values)
    if mean is None:
        return ["", ""]
    of = "" if len(mean.values) == len(values) else f" (of {len(mean.values)})"
    return [_signed(mean.mean, unit) + of, _spread(mean, unit)]


def _spread(mean: Mean, unit: str) -> str:
    """Write an interval; one image has none."""
    return f"{_signed(mean.low, unit)} to {_signed(mean.high, unit)}" if len(mean.values) > 1 else ""


def bd_each(points: Sequence[Point], group: str) -> str:
    """Bjontegaard's differences of every image, the most lost first."""
    header = ["image", "against", "BD-rate of PSNR, %", "overlap, dB", "BD-PSNR, dB"]
    header += ["BD-rate of EF-PSNR, %", "overlap, dB", "BD-EF-PSNR, dB"]
    lines = []
    for rival in RIVALS:
        found = {quality: deltas(points, group, rival, quality) for quality in (PSNR, EF_PSNR)}
        for image in found[PSNR]:
            both = [found[quality].get(image) for quality in (PSNR, EF_PSNR)]
            cells = []
            for d in both:
                cells += ["", "", ""] if d is None else [_signed(d.rate, "%"), f"{d.overlap:.1f}", signed(d.quality)]
            lines.append((both[0], [image, rival, *cells]))
    lines.sort(key=lambda line: -math.inf if line[0] is None or math.isnan(line[0].rate) else -line[0].rate)
    return markdown(header, [cells for _, cells in lines])


def precision_table(points: Sequence[Point]) -> str:
    """What a Gaussian takes in a file that shows nearly what the fit does, most first."""
    header = ["frame", "N", "PSNR", "file's PSNR", "lost, dB", "EF-PSNR", "file's EF-PSNR", "in the file", "bytes"]
    header += ["bits a Gaussian", "to those of the fit", "setting", "s, compress"]
    lines = []
    for scene, file, bits in sorted(bits_a_gaussian(points), key=lambda line: -line[2]):
        line = [scene.image, count(scene.num_gaussians), db(scene.psnr), db(file.psnr), db(scene.psnr - file.psnr)]
        line += [db(scene.ef_psnr), db(file.ef_psnr), count(file.num_gaussians), count(file.bytes), f"{bits:.1f}"]
        line += [f"{8 * file.bytes / scene.num_gaussians:.1f}", file.setting, seconds(file.encode_seconds)]
        lines.append(line)
    return markdown(header, lines)


def maps_table(points: Sequence[Point]) -> str:
    """What label maps take, by folder."""
    share = shares(points)
    here = [p for p in points if p.group == MAPS]
    lines = []
    for folder in dict.fromkeys(image.split("/")[0] for image in share):
        some = {image: value for image, value in share.items() if image.split("/")[0] == folder}
        mean, worst = mean_of(some), max(some, key=lambda image: some[image])
        assert mean is not None
        line = [folder, str(len(some))]
        line += [
            count(statistics.fmean(p.bytes for p in here if p.codec == codec and p.image in some))
            for codec in (LOSSLESS_WEBP, LABELS)
        ]
        line += [f"{mean.mean:.1f} %", f"{mean.low:.1f} to {mean.high:.1f} %", f"{worst} {some[worst]:.1f} %"]
        lines.append(line)
    header = ["maps", "how many", f"bytes, {LOSSLESS_WEBP}", f"bytes, {LABELS}", "share, mean", "95 %", "worst"]
    return markdown(header, lines)


def speed_table(points: Sequence[Point]) -> str:
    """Seconds of each step."""
    lines = []
    for p in points:
        if p.group == SPEED:
            took = p.decode_seconds if p.codec == DECODE else p.encode_seconds
            lines.append([p.image, count(p.num_gaussians), p.codec, count(p.bytes), f"{1e3 * took:.0f}"])
    return markdown(["frame", "Gaussians", "what", "bytes", "ms, median"], lines)


def dropped(points: Sequence[Point]) -> str:
    """Name the files of kcgs that hold no map though one was given."""
    found = [f"{p.image} at {p.bytes:,} bytes ({p.group})" for p in points if p.codec == KCGS and p.regions == 1]
    return f"{KCGS.capitalize()} left the map out of: {', '.join(found) or 'no file'}."


def present_rivals(points: Sequence[Point]) -> list[str]:
    """Name the codecs that have matched files."""
    return [rival for rival in (*CODECS, NO_REGIONS) if pairs(points, rival)]


def _curve_groups(points: Sequence[Point]) -> list[str]:
    return list(dict.fromkeys(p.group for p in points if p.group.endswith("curve")))


def _signed(value: float, unit: str) -> str:
    if unit == "1":
        return "" if math.isnan(value) else f"{value:+.3f}"
    return signed(value) if unit == "dB" else "" if math.isnan(value) else f"{value:+.1f}"
