"""From points to a report with tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from kcgs._atomic import atomic_path
from kcgs.bench.cells import write_csv
from kcgs.bench.machine import describe

from .codecs import AVIF_PSNR, versions
from .figures import plot_curves, plot_matched
from .gains import Line, lines
from .groups import SPEED_THREADS
from .pictures import DAVIS_CURVE, KODAK_CURVE, MAPS, MATCHED, MOST_BYTES, PRECISION, SPEED
from .points import KCGS, NO_REGIONS, Point
from .tables import (
    bd_each,
    bd_means,
    bounds_table,
    dropped,
    each_frame,
    losses,
    maps_table,
    matched_means,
    no_overlap,
    precision_table,
    present_rivals,
    speed_table,
)
from .workshop import MOST_LOSS

_INTRODUCTION = f"""Bytes are those of real files, everything in them included. `{KCGS}` is `kcgs.fit.fit_bytes` with
the map that is given on DAVIS (the annotation of the first frame), and with the one that `kcgs.segment.segment` finds
on Kodak; `{NO_REGIONS}` is the same without a map. The others are Pillow's: JPEG with optimize and progressive, 4:2:0
or 4:4:4, whichever has the higher PSNR; WebP with method 6; AVIF with speed 0, as it comes and, as `{AVIF_PSNR}`, told
to mind PSNR, in 4:2:0 or 4:4:4, whichever is better. PSNR is over the whole image, EF-PSNR and EF-SSIM within 5 pixels
of the contours of that map. Gained is what kcgs has over the other, in dB. Intervals are the bootstrap's, 95 %, of the
mean over images drawn in pairs. Seconds to encode are those of the final setting, the search for it excluded; of kcgs
those of the whole fit and of finding the map, to decode until the picture is there; medians, compilation excluded. What
else the machine did meanwhile slows them."""
_MATCHED_TEXT = f"""Every codec made its largest file of at most {MOST_BYTES:,} bytes, or its smallest if it cannot go
as low. Kcgs was fitted to the bytes of the larger AVIF file; the fit was written again with the bytes of each other
file, unless nearly as many were there already. Each file of another codec meets the largest of kcgs' that has no more
bytes; of the codecs that cannot go as low, one of far fewer. Without regions kcgs was asked for the bytes that it was
fitted to with them."""
_CURVE_TEXT = """Files of about 2,000, 4,000, 8,000, 16,000 and 32,000 bytes; a codec that cannot go as low has its
smallest file there. BD-rate is how many more bits kcgs takes for the same quality, in %, below zero where it saves
bits; BD-PSNR how much better it is at the same bits. Both are means over where two curves overlap, log-rate over
quality and quality over log-rate interpolated by monotone cubics (PCHIP); similarities count as -10 log10(1 - x)."""
_PRECISION_TEXT = f"""A fit of N Gaussians with the annotation's contours, and the smallest of a few files by
`kcgs.fit.compress` that loses at most {MOST_LOSS} dB of its PSNR. Header, map and checksums count. Gaussians that do
not pay for their bits are left out of the file; bits are for each that is in it, and beside that for each of those
fitted."""
_MAPS_TEXT = """Bytes of a label map alone, its size not included, beside Pillow's lossless WebP with quality 100 and
method 6."""
_SPEED_TEXT = f"""Medians on {SPEED_THREADS} threads: `kcgs.fit.compress`, `kcgs.codec.encode`, and a file decoded and
drawn, in a process that has done so before."""
_QUICK_TEXT = "The short form, one small picture and few iterations: the numbers only show that all of it runs."


def write(output: Path, points: Sequence[Point], notes: Sequence[str], quick: bool) -> None:
    """Write report.md, summary.csv and the figures into the folder.

    Args:
        output: folder.
        points: all that is there.
        notes: what is missing.
        quick: whether it is the short form.
    """
    parts = ["# Quality against bytes", f"Made by `kcgs bench rate{' --quick' if quick else ''}`."]
    parts.append("\n".join(f"- {line}" for line in [*describe(), versions(), f"Threads: {torch.get_num_threads()}"]))
    if quick:
        parts.append(_QUICK_TEXT)
    if notes:
        parts.append("\n".join(f"- {note}" for note in notes))
    parts.append(_INTRODUCTION)
    if points:
        parts += ["## Where kcgs loses", losses(points)]
        if not quick:
            parts += ["## Bounds", bounds_table(points)]
        parts += _sections(points, output)
    with atomic_path(output / "report.md") as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    write_csv(output / "summary.csv", Line._fields, lines(points))


def _sections(points: Sequence[Point], output: Path) -> list[str]:
    groups = {p.group for p in points}
    parts = []
    rivals = present_rivals(points)
    if rivals:
        plot_matched(points, output / "matched.png")
        parts += [f"## At {MOST_BYTES:,} bytes: {MATCHED}", _MATCHED_TEXT, matched_means(points), "![](matched.png)"]
    curves = [group for group in (DAVIS_CURVE, KODAK_CURVE) if group in groups]
    if curves:
        parts += ["## Curves", _CURVE_TEXT, no_overlap(points)]
    for group in curves:
        here = [p for p in points if p.group == group]
        plot_curves(here, output / f"{group}.png")
        images = ", ".join(dict.fromkeys(p.image for p in here))
        parts += [f"### {group}", f"Pictures: {images}.", bd_means(points, group), f"![]({group}.png)"]
        parts.append(bd_each(points, group))
    if curves or rivals:
        parts.append(dropped(points))
    for group, title, text, table in (
        (PRECISION, "Bits a Gaussian", _PRECISION_TEXT, precision_table),
        (MAPS, "Label maps", _MAPS_TEXT, maps_table),
        (SPEED, "Speed", _SPEED_TEXT, speed_table),
    ):
        if group in groups:
            parts += [f"## {title}", text, table(points)]
    for rival in rivals:
        parts += [f"## Each frame at {MOST_BYTES:,} bytes: against {rival}", each_frame(points, rival)]
    return parts
