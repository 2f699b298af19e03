"""Clips beside files of single frames and other codecs: `kcgs bench video`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from kcgs.functional import edge_band
from kcgs.plots import COLORS, figure, save_figure

from . import _video_tables as tables
from ._video_codecs import is_there
from ._video_runs import (
    AS_IT_IS,
    BETWEEN,
    BYTES,
    CLIP,
    CODECS,
    LENGTHS,
    QUALITY,
    SPARSE,
    VARIANTS,
    Run,
    Runs,
    Shot,
    threads,
)
from .core import images
from .core.figures import CROPS, MARKERS, add_legend, cut_crops, plot_images
from .core.jobs import check_made
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows


class Plan(NamedTuple):
    """What is run."""

    counts: tuple[int, ...]  # N
    frames: int  # of each sequence
    pairs: tuple[tuple[int, int], ...]  # of frames that are fitted by themselves
    part_frames: int  # of the clips with parts taken out, at the first N
    part_sequences: tuple[str, ...]


FULL = Plan((1_250, 2_500), 24, ((0, 1), (11, 12), (22, 23)), 12, ("car-turn", "dance-jump", "dog"))
QUICK = Plan((60,), 4, ((2, 3),), 3, ("blackswan", images.QUICK[0]))
_FRAMES, _TIME = "psnr.png", "error-against-time.png"
_INTRODUCTION = f"""A clip is `kcgs.fit_video` with the annotated maps, its frame 0 a key frame, all in one file.
`{QUALITY}` are those that `kcgs fit IMAGE --regions MASK -n N -o x.kcgs` makes of single frames, `{BYTES}` those of
`kcgs.rate.fit_bytes` with the clip's mean bytes per frame. Other codecs have one key frame, slow presets tuned for
PSNR, and at most the clip's bytes, streams without a container. EF-PSNR is along the annotated contours. Flicker is the
mean squared error, in 8-bit levels, of the change between two frames beside that of the photos; *along the
motion*, the change of the error at places that move with their region, as the photos do: what an eye sees that follows
it. Seconds are processor time. Each frame by itself: results.csv."""
_SAMPLE_TEXT = """Files of single frames are made of the neighbouring frames {pairs} only, to save hours, and those of
equal bytes of the later of each pair. Clips are compared with them on these frames without frame 0, a key frame, which
is one of a clip's frames but would be one of few here; bytes are those of all frames. The change from frame 0 to 1 is
also one from a key frame to a carried one, whose bits are fewer. Where carrying does not pay all frames are key frames,
and the clip is files of single frames in one."""
_BETWEEN_TEXT = """A clip of every second frame is rendered halfway between its frames and compared with the frame that
was left out; beside it the means of the two neighbouring frames, as the clip renders them and as photos."""
_PARTS_TEXT = """Means over the carried frames of {frames}-frame clips of {names}, N = {n:,}, whose frames are all
carried but the first, whatever that loses. The first line is the encoder as it is; in the others a part is taken out,
or descents have other lengths."""


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    results = tables.Results(read_rows(output / "results.csv", Shot))
    plan = QUICK if made.quick else FULL
    text = [f"Sequences: {', '.join(results.sequences)}; {plan.frames} frames of each."]
    parts = ["# Video: frames carried on from the one before", _INTRODUCTION, *(text if results.sequences else [])]
    if not results.sequences:
        return parts
    sample = _SAMPLE_TEXT.format(pairs=", ".join(f"{a} and {b}" for a, b in plan.pairs))
    parts += ["## Goals", sample, tables.goals(results)]
    parts += ["## Against other codecs at the clip's bytes", tables.against_codecs(results)]
    _plot_frames(output / _FRAMES, results)
    parts += [f"![]({_FRAMES})", *(["## Crops", _crops_text(plan), f"![]({CROPS})"] if _has_crops(output) else [])]
    parts += ["## All frames but the first", tables.means(results, dict.fromkeys((CLIP, *CODECS)))]
    later = [pair[1] for pair in plan.pairs]
    which = f"## Frame{'s' * (len(later) > 1)} {', '.join(map(str, later))}"
    parts += [which, tables.means(results, dict.fromkeys((CLIP, QUALITY, BYTES, *CODECS), later))]
    for n in results.counts:
        parts += [f"## Each sequence, N = {n:,}", tables.by_sequence(results, n), tables.beside_files(results, n)]
    if any(results.whose(n, BETWEEN) for n in results.counts):
        parts += ["## In between", _BETWEEN_TEXT, tables.between(results)]
    if found := tables.parts(results):
        _plot_times(output / _TIME, found)
        names = ", ".join(results.whose(results.counts[0], next(iter(VARIANTS))))
        words = _PARTS_TEXT.format(frames=plan.part_frames, names=names, n=results.counts[0])
        parts += ["## Error against run time, and what each part brings", words]
        parts += [tables.parts_table(found), f"![]({_TIME})"]
    return parts


@experiment("engine", "workers", "sequences", report=report)
def run(output: Path, options: Options) -> None:
    """Fit clips, files and streams; what is there, in `output`/files, is not made again."""
    plan = QUICK if options.quick else FULL
    names, runs = choose(options, plan), Runs(output / "files", options.data, options.quick)
    failed: list[str] = []
    try:
        failed += runs.obtain(first(names, plan), options.place)
        failed += runs.obtain(second(runs, names, plan), options.place)
    finally:
        wanted = [*first(names, plan), *second(runs, names, plan)]
        shots = {run: found for run in wanted if (found := runs.shots(run)) is not None}
        write_rows(output / "results.csv", Shot, [shot for found in shots.values() for shot in found])
        _plot_crops(output / CROPS, runs, list(shots), plan)
        made = options.made("video", _notes(names, plan, shots, wanted))
        conclude(report, output, made._replace(machine=(*made.machine, threads())))
    check_made(failed)


def choose(options: Options, plan: Plan) -> list[str]:
    """List the sequences; a ValueError where one has too few frames."""
    if options.data is None:
        return images.sequences(None, options.sequences, quick=options.quick)
    davis = images.davis(options.data)
    whole = [name for name in davis.sequences if len(davis.sequence(name)) >= plan.frames]
    if not whole:
        raise ValueError(f"data must have sequences of {plan.frames} frames or more; got {options.data}")
    if options.sequences is None:
        return whole[: 2 if options.quick else None]
    names = images.sequences(options.data, options.sequences, quick=False)
    if not set(names) <= set(whole):
        which = f"{plan.frames} frames or more, {', '.join(whole)}"
        raise ValueError(f"sequences must be of {which}; got {options.sequences!r}")
    return names


def first(names: Sequence[str], plan: Plan) -> list[Run]:
    """List what depends on nothing else, sequence by sequence."""
    wanted, every = list[Run](), tuple(range(plan.frames))
    for name in names:
        wanted += [Run(name, n, CLIP, every) for n in plan.counts]
        wanted += [Run(name, n, QUALITY, pair) for n, pair in product(plan.counts, plan.pairs)]
        wanted.append(Run(name, plan.counts[0], SPARSE, every[:-1:2]))
        if name in plan.part_sequences:
            wanted += [Run(name, plan.counts[0], variant, every[: plan.part_frames]) for variant in VARIANTS]
    return wanted


def second(runs: Runs, names: Sequence[str], plan: Plan) -> list[Run]:
    """List what has the bytes of a clip that is there."""
    wanted, every = list[Run](), tuple(range(plan.frames))
    for name, n in product(names, plan.counts):
        if (found := runs.shots(Run(name, n, CLIP, every))) is not None:
            size = round(sum(shot.bytes for shot in found))
            wanted += [Run(name, n, BYTES, (later,), size // plan.frames) for _, later in plan.pairs]
            wanted += [Run(name, n, label, every, size) for label, codec in CODECS.items() if is_there(codec)]
    return wanted


def _notes(names: Sequence[str], plan: Plan, shots: dict[Run, list[Shot]], wanted: Sequence[Run]) -> list[str]:
    """Say what is missing."""
    clips = len(plan.counts) * len(names)
    lacking = clips - sum(run.method == CLIP for run in shots)
    notes = [f"Stopped before its end: {lacking} of {clips} clips are not there."] if lacking else []
    if not lacking and len(shots) < len(wanted):
        notes.append(f"Stopped before its end: {len(shots)} of {len(wanted)} runs are there.")
    notes += [f"{label}: PyAV or its encoder is not installed." for label, c in CODECS.items() if not is_there(c)]
    low = [run for run, found in shots.items() if not found]
    return notes + [f"{r.sequence}, N = {r.n:,}: {r.method} cannot go as low as {r.most:,} bytes." for r in low]


def _has_crops(output: Path) -> bool:
    return (output / CROPS).is_file()


def _crops_text(plan: Plan) -> str:
    return f"Frame {plan.pairs[-1][1]}, N = {plan.counts[0]:,}, where the annotated map has most contours in a crop."


def _plot_crops(path: Path, runs: Runs, there: Sequence[Run], plan: Plan) -> None:
    """Show the last frame that was fitted by itself, at its contours."""
    found = list(_crops(runs, there, plan))
    most = max(map(len, found), default=0)
    rows = [row for row in found if len(row) == most]
    if rows:
        plot_images(path, *rows)
    else:
        path.unlink(missing_ok=True)


def _crops(runs: Runs, there: Sequence[Run], plan: Plan) -> Iterator[dict[str, Tensor]]:
    frame, shown = plan.pairs[-1][1], (CLIP, QUALITY, "x264", "AV1")
    for name in dict.fromkeys(run.sequence for run in there):
        same = [r for r in there if r.sequence == name and r.n == plan.counts[0] and frame in r.frames]
        ((photo, labels),) = runs.samples(name, (frame,))
        found = {"photo": photo}
        for run in (r for method in shown for r in same if r.method == method and runs.shots(r)):
            found[run.method] = runs.shown(run)[run.frames.index(frame)]
        if labels is not None:
            yield from (row for _, row in cut_crops(name, found, edge_band(labels).float(), 1))


def _plot_frames(path: Path, results: tables.Results) -> None:
    """Plot PSNR over frames, a row for each sequence and a column for each N."""
    names, counts = results.sequences, results.counts
    plot, axes = figure(len(names), len(counts), width=9.5, height=0.8 + 2.2 * len(names))
    for name, row in zip(names, np.reshape(axes, (len(names), len(counts))), strict=True):
        for n, axis in zip(counts, row, strict=True):
            for index, method in enumerate((CLIP, *CODECS, QUALITY, BYTES)):
                points = sorted((frame, shot.psnr) for frame, shot in results.of(name, n, method).items())
                if points:
                    style: dict[str, Any] = {"color": COLORS[index], "label": method, "markersize": 4}
                    if method not in (CLIP, *CODECS):
                        style |= {"linestyle": "none", "marker": MARKERS[index]}
                    axis.plot(*zip(*points, strict=True), **style)
            axis.set(xlabel="frame", ylabel="PSNR (dB)", title=f"{name}, N = {n:,}")
    add_legend(plot, plot.axes[0], columns=6, where="upper")
    save_figure(plot, path)


def _plot_times(path: Path, found: Sequence[tables.Part]) -> None:
    """Plot quality and bytes of carried frames against their processor time."""
    plot, axes = figure(1, 3, width=9.5, height=3.4)
    points = {part.name: part.ours for part in found}
    lengths = [name for name in (AS_IT_IS, *LENGTHS) if name in points]
    lengths.sort(key=lambda name: LENGTHS.get(name, 1.0))
    for axis, (field, title) in zip(
        axes, {"psnr": "PSNR (dB)", "ef_psnr": "EF-PSNR (dB)", "bytes": "bytes"}.items(), strict=True
    ):
        for index, (name, point) in enumerate(points.items()):
            style: dict[str, Any] = {"color": COLORS[index % len(COLORS)], "marker": MARKERS[index % len(MARKERS)]}
            axis.plot(point["seconds"], point[field], linestyle="", label=name, markersize=5, **style)
        line = [(points[name]["seconds"], points[name][field]) for name in lengths]
        axis.plot(*zip(*line, strict=True), color="0.6", linewidth=1, zorder=0)
        axis.set(xlabel="processor seconds of a carried frame", ylabel=title)
    add_legend(plot, axes[0], columns=4)
    save_figure(plot, path)
