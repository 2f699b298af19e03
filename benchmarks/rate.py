"""Quality against the sizes of real files, beside other codecs: `python -m benchmarks rate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import torch
from torch import Tensor

from kcgs.plots import COLORS, figure, save_figure

from . import _rate_tables as tables
from ._codecs import AVIF, AVIF_FAST, AVIF_PSNR, JPEG, WEBP, present, versions
from ._rate_files import KCGS, MAPS, MOST_LOSS, MS_SSIM, NO_REGIONS, Files, Point
from ._rate_tables import MOST_BYTES, PRECISION
from .core import images
from .core.figures import CROPS, add_legend, plot_crops, save_sheet, show_crops
from .core.jobs import with_progress
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows

GROUPS = (tables.MATCHED, PRECISION, MAPS, tables.DAVIS_CURVE, tables.KODAK)
_NAMES = {
    tables.MATCHED: images.FRAMES,
    PRECISION: images.FRAMES[:4],
    tables.DAVIS_CURVE: images.FRAMES[:3],
}
QUICK_IMAGE, QUICK_BYTES = "disc", 700
TARGETS, QUICK_TARGETS = (2_000, 4_000, 8_000, 16_000, 32_000), (450, 900)
COUNTS, QUICK_COUNTS = (1_250, 7_500), (40,)
_SHEET = "frames.jpg"
_SHEET_TEXT = f"[All frames at full size]({_SHEET}). From left to right: photo, {KCGS}, {MS_SSIM}, {AVIF}."
# share of another file's bytes that is nearly as many
_NEAR = 0.98
# colour, line and marker of each codec, the same everywhere
_STYLES = {
    KCGS: (COLORS[1], "-", "o"),
    NO_REGIONS: (COLORS[4], "--", "s"),
    JPEG: (COLORS[7], ":", "v"),
    WEBP: (COLORS[2], "-.", "^"),
    AVIF: (COLORS[5], "--", "D"),
    AVIF_PSNR: (COLORS[0], "-", "P"),
}
_INTRODUCTION = f"""Bytes are those of real files, everything in them included. `{KCGS}` is `kcgs.rate.fit_bytes` with
the map that is given on DAVIS, and with the one that `kcgs.segment.segment` finds on Kodak; `{NO_REGIONS}` is the same
without a map, `{MS_SSIM}` with that objective. Gained is what kcgs has over the other. The other
codecs, and how curves are compared: docs/results.md. Seconds are medians, of kcgs those of the whole fit. Each file by
itself: results.csv."""
_MATCHED_TEXT = f"""Every codec made its largest file of at most {MOST_BYTES:,} bytes, or its smallest if it cannot go
as low. Each meets the largest file of kcgs that has no more bytes. Without regions kcgs was asked for the bytes that it
was fitted to with them, and with the other objectives for AVIF's."""
_KODAK_TEXT = f"""Every file has at most the bytes of the bits per pixel that were asked for. Gained is the PSNR that
`{NO_REGIONS}` has over the line's codec on the photos that both have. AVIF's steps are coarse, so its files are
smaller; BD-rates allow for that. Products per pixel are an estimate of what the renderer multiplies: 14 for each pair
of a Gaussian and a pixel, or a node of its coarse grid, whose weight is at least the cutoff (5 for the exponent, 6 for
the power of two, 3 for the colours), and 30 for the splines. Evaluated pairs outside of ellipses, and the decoding of
the bytes, are not counted. `{AVIF_FAST}` takes a tenth of the time of speed 0; it lost 0.1 to 0.2 dB on one photo."""
_SECTIONS = {
    tables.KODAK: ("Kodak", tables.kodak, _KODAK_TEXT),
    PRECISION: ("Bits per Gaussian", tables.precision_table, f"""A fit of N Gaussians with the annotation's contours,
and the smallest of a few files by `kcgs.rate.compress` that loses at most {MOST_LOSS} dB of its PSNR."""),
    MAPS: ("Label maps", tables.maps_table, """Bytes of a label map alone, beside Pillow's lossless WebP."""),
}  # fmt: skip

# makes some files of one image; those that are not there, and may not be made, are left out
Step = Callable[[], list[Point]]


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    points = read_rows(output / "results.csv", Point)
    parts = ["# Quality against bytes", _INTRODUCTION]
    if not points:
        return parts
    parts += ["## Where kcgs loses", tables.losses(points)]
    rivals = [rival for rival in tables.RIVALS if tables.pairs(points, rival)]
    if rivals:
        parts += [f"## At {MOST_BYTES:,} bytes: {tables.MATCHED}", _MATCHED_TEXT, tables.matched_means(points)]
        parts += show_crops(output, KCGS)
        parts += [_SHEET_TEXT] if (output / _SHEET).is_file() else []
    of_curve = [p for p in points if p.group == tables.DAVIS_CURVE]
    if of_curve:
        _plot_curves(of_curve, output / f"{tables.DAVIS_CURVE}.png")
        parts += ["## Curves", f"Images: {', '.join(dict.fromkeys(p.image for p in of_curve))}."]
        parts += [tables.bd_means(points, tables.DAVIS_CURVE), f"![]({tables.DAVIS_CURVE}.png)"]
    for group, (title, table, text) in _SECTIONS.items():
        if any(p.group == group for p in points):
            parts += [f"## {title}", text, table(points)]
    return parts


@experiment("only", report=report)
def run(output: Path, options: Options) -> None:
    """Compare files of kcgs with those of other codecs.

    Every finished file is kept in `output`/files, so that the same call goes on where an earlier one was interrupted;
    those of kcgs are made anew once the codec has changed. Remove the folder to measure changed fits anew. Without
    `only`, all groups are run that can be.
    """
    chosen = choose(options)
    files = Files(output / "files", options.data, options.quick)
    todo = [(f"{group}: {name}", step) for group in chosen for name, step in steps(group, files)]
    try:
        for step in with_progress(todo):
            step()
    finally:
        kept = Files(files.folder, files.data, files.quick, makes=False)
        points, notes = _collect(kept, chosen)
        write_rows(output / "results.csv", Point, points)
        for name in (CROPS, _SHEET):
            (output / name).unlink(missing_ok=True)
        frames = list(_frames(kept, points))
        plot_crops(output / CROPS, frames)
        save_sheet(output / _SHEET, frames)
        made = options.made("rate", notes)
        conclude(report, output, made._replace(machine=(versions(), f"Threads: {torch.get_num_threads()}")))


def choose(options: Options) -> list[str]:
    """List the groups that are asked for; a ValueError where one has no images in the data, or none has."""
    able = [group for group in GROUPS if names(group, options.data, options.quick)]
    if not able:
        raise ValueError("data must be a folder with DAVIS, bsds or kodak in it; without one there is only quick")
    if options.only is None:
        return able
    wanted = options.only.replace(" ", "").split(",")
    if not set(wanted) <= set(able):
        raise ValueError(f"only must name groups with images, {', '.join(able)}, with commas; got {options.only!r}")
    return [group for group in GROUPS if group in wanted]


def names(group: str, data: Path | None, quick: bool) -> list[str]:
    """List a group's images that are there."""
    if quick:
        return [] if group == tables.KODAK else [QUICK_IMAGE]  # one curve will do
    if data is None:
        return []
    if group == tables.KODAK:
        return sorted(path.stem for path in (data / "kodak").glob("kodim*.png"))
    frames = images.davis(data).sequences if (data / "DAVIS").is_dir() else []
    if group != MAPS:
        return [name for name in _NAMES[group] if name in frames]
    masks = sorted((data / "bsds").glob("*/mask*.png"), key=lambda path: (len(path.parent.name), path))
    return [*(f"DAVIS/{name}" for name in frames), *(f"bsds/{path.parent.name}/{path.stem}" for path in masks)]


def steps(group: str, files: Files) -> Iterator[tuple[str, Step]]:
    """List what a group measures, by name."""
    found = names(group, files.data, files.quick)
    if group == tables.MATCHED:
        # first what all frames need, for a run that is stopped
        yield from ((image, partial(_matched, files, image)) for image in found)
        others = [(image, codec) for codec in (NO_REGIONS, MS_SSIM) for image in found]
        yield from ((f"{image}, {codec}", partial(_matched_other, files, image, codec)) for image, codec in others)
    elif group == tables.KODAK:
        # whole means first, for a run that is stopped
        for codec in tables.KODAK_CODECS:
            for most, image in product(tables.RATES, found):
                ours = partial(files.fitted, group, image, most, codec)
                other = partial(files.other, group, image, codec, most)
                yield f"{image} {most:,}, {codec}", other if codec == AVIF_FAST else ours
    elif group == tables.DAVIS_CURVE:
        for image in found:
            for most in QUICK_TARGETS if files.quick else TARGETS:
                yield f"{image} {most:,}", partial(_on_curve, files, group, image, most)
    elif group == MAPS:
        yield from ((image, partial(files.label_map, image)) for image in found)
    else:
        for image in found:
            for n in QUICK_COUNTS if files.quick else COUNTS:
                yield f"{image} N = {n:,}", partial(_precision, files, image, n)


def _collect(kept: Files, chosen: Sequence[str]) -> tuple[list[Point], list[str]]:
    """Return all points that are there, also of unfinished steps, and what is missing."""
    points, notes = list[Point](), list[str]()
    for group in GROUPS:
        todo, whole = [step for _, step in steps(group, kept)], 0
        for step in todo:
            before, found = kept.missed, step()
            points += found
            whole += bool(found) and kept.missed == before
        if whole < len(todo):
            why = "stopped before its end" if group in chosen else "not chosen"
            notes.append(f"{group}: {why}, {whole} of {len(todo)} steps are finished.")
        elif not todo and not kept.quick:
            notes.append(f"{group}: the data folder has none of its images.")
    absent = [name for name in (JPEG, WEBP, AVIF) if name not in present()]
    return points, [*notes, *(f"This Pillow has no {name}." for name in absent)]


def _matched(files: Files, image: str) -> list[Point]:
    """Make other codecs' files, then kcgs' of no more bytes than each.

    A fit is made for the larger of AVIF's files. It is written again for the others, unless there is a file of nearly
    as many bytes already, or they could not go as low.
    """
    most = QUICK_BYTES if files.quick else MOST_BYTES
    others = [p for codec in present() for p in files.other(tables.MATCHED, image, codec, most)]
    avif = sorted({p.bytes for p in others if p.codec in (AVIF, AVIF_PSNR)}, reverse=True) or [most]
    ours = files.fitted(tables.MATCHED, image, avif[0]) if len(others) == len(present()) else []
    for first in ours[:1]:
        for smaller in avif[1:]:
            ours += files.rewritten(first, smaller)
        for point in others:
            least = _NEAR * point.bytes if point.bytes <= most else 0.0
            if not any(least <= file.bytes <= point.bytes for file in ours):
                ours += files.rewritten(first, point.bytes)
    return [*others, *ours]


def _matched_other(files: Files, image: str, codec: str) -> list[Point]:
    kept = Files(files.folder, files.data, files.quick, makes=False)
    found = _matched(kept, image)
    most = [p.asked for p in found if p.regions]
    if codec != NO_REGIONS and most:
        most = [p.bytes for p in found if p.codec == AVIF] or most
    return files.fitted(tables.MATCHED, image, most[0], codec) if most else []


def _frames(kept: Files, points: Sequence[Point]) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """Show each matched photo beside its files of no more bytes than AVIF's, and that."""
    similar = {pair.other.image: pair.ours for pair in tables.pairs(points, AVIF, MS_SSIM)}
    for pair in tables.pairs(points, AVIF):
        image = pair.other.image
        if image in similar:
            shown = {p.codec: kept.shown(p) for p in (pair.ours, similar[image], pair.other)}
            yield image, {"photo": kept.sample(image)[0].image, **shown}


def _on_curve(files: Files, group: str, image: str, most: int) -> list[Point]:
    points = [p for codec in present() for p in files.other(group, image, codec, most)]
    ours = (KCGS,) if files.quick else (KCGS, NO_REGIONS)
    return points + [p for codec in ours for p in files.fitted(group, image, most, codec)]


def _precision(files: Files, image: str, n: int) -> list[Point]:
    scenes = files.scene(PRECISION, image, n)
    return scenes + [p for scene in scenes for p in files.rounded(scene)]


def _plot_curves(points: Sequence[Point], path: Path) -> None:
    """Plot PSNR and EF-PSNR over bits per pixel, a row for each image."""
    shown = list(dict.fromkeys(p.image for p in points))
    plot, axes = figure(len(shown), 2, width=9.5, height=0.8 + 3.0 * len(shown))
    rows = axes if len(shown) > 1 else [axes]
    for image, row in zip(shown, rows, strict=True):
        for axis, quality in zip(row, (tables.PSNR, tables.EF_PSNR), strict=True):
            for codec, (color, line, marker) in _STYLES.items():
                found = sorted((p.bpp, getattr(p, quality)) for p in points if (p.image, p.codec) == (image, codec))
                if found:
                    x, y = zip(*found, strict=True)
                    axis.plot(x, y, line, marker=marker, color=color, markersize=4, linewidth=1.3, label=codec)
            axis.set_xscale("log", base=2)
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set(xlabel="bits per pixel", ylabel=f"{tables.QUALITIES[quality][0]} (dB)", title=image)
    add_legend(plot, rows[0][0], columns=len(_STYLES), where="upper")
    save_figure(plot, path)
