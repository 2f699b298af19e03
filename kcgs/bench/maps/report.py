"""From results to a report with tables and a figure."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from kcgs._atomic import atomic_path
from kcgs.bench.cells import count, db, markdown, seconds, signed
from kcgs.bench.fits import HERE, Place
from kcgs.bench.machine import describe

from .figures import plot_gains
from .gains import TIE, Gain, bounds, gain_of
from .trials import AUTO, NO_MAP, OTHERS, Result, Trial

_INTRODUCTION = """No map is given: each comes from the picture itself, by `kcgs.segment.segment(picture, source)` with
its default options, and the fit is that of `kcgs fit --regions auto`: the recipe `best` with contours that may move
freely, which is `{ours}`. The baseline is `{baseline}` with as many Gaussians. PSNR is over the whole image;
EF-PSNR within 5 pixels of the contours of the final map, the one that the scene stores: both pictures are measured in
that same band. Gained is what the fit with the map has over the baseline, in dB. An image whose final map has no
contour has no band. Intervals are the bootstrap's, 95 %, of the mean over images drawn in pairs. Bytes are those of the
scene's `.kcgs` file, and the map's share of them. Seconds are wall time, compilation excluded, in summaries medians;
what else the machine did meanwhile slows them."""
_BYTES_TEXT = """Gains above are at equal numbers of Gaussians, and a map's bytes come on top. Here the baseline has
the Gaussians that the bytes of the scene's file buy, the map's included, and what both files decode to is compared.
Files are written by `kcgs.codec.encode(field, regions, quality=psnr + 14.5)`, without a look at the image."""
_QUANTITIES = {
    "gain": "PSNR",
    "ef_gain": "EF-PSNR",
    "equal_gain": "PSNR at equal bytes",
    "equal_ef_gain": "EF-PSNR at equal bytes",
}
_BOUNDS_TEXT = "What automatic maps (`auto`) are held to, over all images."
_QUICK_TEXT = "The short form, small pictures and few iterations: the numbers only show that all of it runs."


def write(output: Path, results: Sequence[Result], *, planned: int, quick: bool, place: Place = HERE) -> None:
    """Write report.md and its figure into the folder.

    Args:
        output: folder.
        results: all that is there.
        planned: how many there should be.
        quick: whether it is the short form.
        place: where fits that were missing were made.
    """
    parts = ["# Label maps found in the picture", f"Made by `kcgs bench maps{' --quick' if quick else ''}`."]
    parts.append("\n".join(f"- {line}" for line in [*describe(), f"Fits: {place}"]))
    if quick:
        parts.append(_QUICK_TEXT)
    if len(results) < planned:
        parts.append(f"Stopped before its end: {len(results)} of {planned} fits with a map are there.")
    names = [Trial("", 1, source).case().name for source in (AUTO, NO_MAP)]
    parts.append(_INTRODUCTION.format(ours=names[0], baseline=names[1]))
    if results:
        parts += _sections(results, output, quick)
    with atomic_path(output / "report.md") as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _sections(results: Sequence[Result], output: Path, quick: bool) -> list[str]:
    automatic = [r for r in results if r.source == AUTO]
    parts = ["## Where a map does not help", failures(results)]
    if not quick:
        parts += ["## Bounds", _BOUNDS_TEXT, bounds_table(automatic)]
    plot_gains(results, output / "gains.png")
    parts += ["## Automatic maps", summary(automatic), "![](gains.png)"]
    parts += ["### At equal bytes", _BYTES_TEXT, at_equal_bytes(automatic)]
    others = [r for r in results if r.source in OTHERS]
    if others:
        images = list(dict.fromkeys(r.image for r in others))
        n = others[0].n
        beside = [r for r in automatic if r.image in images and r.n == n] + others
        parts += ["## Other sources", f"On {len(images)} of the images: {', '.join(images)}.", summary(beside)]
    for n in sorted({r.n for r in automatic}):
        parts += [f"## Each image: auto, N = {n:,}", each_image([r for r in automatic if r.n == n])]
    if others:
        parts += [f"## Each image: other sources, N = {others[0].n:,}", each_image(others)]
    return parts


def failures(results: Sequence[Result]) -> str:
    """Name the images on which a source loses, worst first, and those whose map has no contour left."""
    lines = []
    for n, source in dict.fromkeys((r.n, r.source) for r in results):
        found = [r for r in results if (r.n, r.source) == (n, source)]
        for quantity, shown in _QUANTITIES.items():
            below = sorted((getattr(r, quantity), r.image) for r in found if getattr(r, quantity) < -TIE)
            if below:
                which = ", ".join(f"{image} {signed(value)}" for value, image in below)
                lines.append(f"- {source}, N = {n:,}, {shown}: {len(below)} of {len(found)} images lose: {which}")
        bare = [r.image for r in found if r.regions == 1]
        if bare:
            lines.append(f"- {source}, N = {n:,}: no contour is left on {', '.join(bare)}")
    return "\n".join(lines) or "Nowhere."


def bounds_table(automatic: Sequence[Result]) -> str:
    """Say of every bound what was measured and whether it is met."""
    lines = [[b.what, signed(b.bound), signed(b.measured), "yes" if b.met else "NO"] for b in bounds(automatic)]
    return markdown(["bound", "dB", "measured", "met"], lines)


def summary(results: Sequence[Result]) -> str:
    """Means of every source at every N, gains with their intervals."""
    header = ["N", "source", "images", "regions", "map bytes", "PSNR gained", "95 %", "won-lost", "worst"]
    header += ["EF-PSNR gained", "95 %", "won-lost", "worst", "s, map", "s, fit", "s, baseline"]
    lines = []
    for n, source in dict.fromkeys((r.n, r.source) for r in results):
        found = [r for r in results if (r.n, r.source) == (n, source)]
        line = [count(n), source, str(len(found)), f"{statistics.fmean(r.regions for r in found):.1f}"]
        line.append(count(statistics.fmean(r.map_bytes for r in found)))
        line += [*_gain_cells(gain_of(found, "gain")), *_gain_cells(gain_of(found, "ef_gain"))]
        for field in ("segment_seconds", "seconds", "baseline_seconds"):
            line.append(seconds(statistics.median(getattr(r, field) for r in found)))
        lines.append(line)
    return markdown(header, lines)


def at_equal_bytes(automatic: Sequence[Result]) -> str:
    """Gains over the baseline of as many bytes."""
    header = ["N", "source", "images", "bytes", "of these map", "baseline's N", "its bytes"]
    header += ["PSNR gained", "95 %", "won-lost", "worst", "EF-PSNR gained", "95 %", "won-lost", "worst"]
    lines = []
    for n in sorted({r.n for r in automatic}):
        found = [r for r in automatic if r.n == n and r.equal_n]
        if found:
            line = [count(n), AUTO, str(len(found))]
            fields = ("bytes", "map_bytes", "equal_n", "equal_bytes")
            line += [count(statistics.fmean(getattr(r, field) for r in found)) for field in fields]
            lines.append([*line, *(c for q in ("equal_gain", "equal_ef_gain") for c in _gain_cells(gain_of(found, q)))])
    return markdown(header, lines)


def each_image(results: Sequence[Result]) -> str:
    """One line a fit; where a map loses comes first."""
    header = ["image", "source", "regions found", "regions kept", "bytes", "map bytes", "PSNR", "baseline", "gained"]
    header += ["EF-PSNR", "baseline", "gained", "s, map", "s, fit", "s, baseline"]
    has_rivals = any(r.equal_n for r in results)
    header += ["baseline's N at equal bytes", "PSNR gained", "EF-PSNR gained"] if has_rivals else []
    lines = []
    for r in sorted(results, key=lambda r: (r.gain >= -TIE, r.gain if r.gain < -TIE else 0.0)):
        line = [r.image, r.source, count(r.given_regions), count(r.regions), count(r.bytes), count(r.map_bytes)]
        line += [db(r.psnr), db(r.baseline_psnr), signed(r.gain)]
        line += [db(r.ef_psnr), db(r.baseline_ef_psnr), signed(r.ef_gain)]
        line += map(seconds, (r.segment_seconds, r.seconds, r.baseline_seconds))
        line += [count(r.equal_n), signed(r.equal_gain), signed(r.equal_ef_gain)] if has_rivals else []
        lines.append(line)
    return markdown(header, lines)


def _gain_cells(gain: Gain | None) -> list[str]:
    if gain is None:
        return [""] * 4
    spread = f"{signed(gain.low)} to {signed(gain.high)}"
    return [signed(gain.mean), spread, f"{gain.wins}-{gain.losses}", f"{gain.worst} {signed(gain.least)}"]
