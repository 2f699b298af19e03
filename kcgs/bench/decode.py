"""How fast and how exactly a scene is rendered by each of its decoders: `kcgs bench decode`."""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from torch import Tensor

from kcgs.plots import COLORS, figure, save_figure
from kcgs.scene import Scene

from . import _decoders as decoders
from ._decoders import CPU, DECODERS, GENERIC, OPENING, SCENE, TILED, YARDSTICK, Entrant, Files, Render, Subject, truth
from .core.clocks import median_ratio, peak_bytes, threads
from .core.jobs import with_progress
from .core.options import Options
from .core.readings import Readings
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows
from .core.tables import markdown, number

CUTOFFS = (1e-2, 1 / 255, 1e-3, 1e-4, 1e-6)
DEFAULT_CUTOFF = 1e-4
THREADS = (1, 2)
FACTORS = {"native": 1, "2x": 2}
SWEPT = (SCENE, CPU, TILED)
RATIO = "bytes to scene"
_MARKERS = "os^D"

_SCENES_TEXT = """Contours are `none` (one region), `hard`, or `soft`. The workloads' soft contours have a standard
deviation of 0.7 pixels."""
_SPEED_TEXT = """Milliseconds for one image, medians; all decoders of a scene are timed in turns in one process, on
one thread and on two, at the default cutoff of 1e-4. `to cpu` is the median of the ratios to torch's `cpu` kernel on
as many threads in the same round. torch's kernels and the generic decoder are given the Gaussians scaled and the
label map sampled for the size that is rendered, once for all images; the scene decoder does both in every image.
Errors are against float64, colours in [0, 1]; values of the workloads' images go up to about 5, since they are sums
of 12 Gaussians."""
_GOAL_TEXT = """What a scene decoder ought to reach: on one thread at the scene's own size at most 10 ms at N = 1,250
and 16 ms at N = 7,500, at most 3 times the `cpu` kernel's time, loaded in under 500 ms, at most 2.5 times the scene's
bytes. Milliseconds are those of this machine."""
_FILES_TEXT = """`bytes to scene` is the size of the scene decoder over that of the scene, which torch reads. The
generic decoder is one file for all scenes and needs the scene beside it. `export` is the time to make and write both
decoders and the scene. Loading goes from the files on disk to being ready to render, onnxruntime's optimisation of the
graph, scaling and sampling the label map included; the first image is loading and rendering once. One thread,
medians."""
_MEMORY_TEXT = """MB added at the peak by loading and rendering one image, on one thread, each in a process of its own
that has rendered a small scene before. At another size that includes sampling the label map, for all but the scene
decoder."""
_SWEEP_TEXT = """One thread, the scene's own size, cutoffs of 1e-2, 1/255, 1e-3, 1e-4 and 1e-6; all timed in turns.
Left and below is better."""
_LEFT_OUT_TEXT = "What each decoder says that it does without."


class Row(NamedTuple):
    """One measured number."""

    section: str
    scene: str
    size: str
    decoder: str
    threads: int
    cutoff: float
    quantity: str
    value: float
    unit: str


class LeftOut(NamedTuple):
    """A sentence of what a decoder says that it does without."""

    decoder: str
    scene: str
    """Empty: any."""
    sentence: str


def report(folder: Path, made: Made) -> list[str]:
    """Write the figures, and return the parts of the report."""
    rows = Readings(read_rows(folder / "results.csv", Row))
    scenes, speed, files, memory = (rows.select(section=name) for name in ("scenes", "speed", "files", "memory"))
    for row in files.select(decoder=SCENE, quantity="size"):
        ratio = row.value / files.value(scene=row.scene, decoder=YARDSTICK, quantity="size")
        files.append(row._replace(quantity=RATIO, value=ratio, unit="1"))
    errors = Readings(row._replace(cutoff=cutoff_name(row.cutoff)) for row in rows.select(section="error"))
    _plot_sweep(errors, folder / "error-against-time.png")
    _plot_speed(speed, folder / "speed.png")
    parts = ["# Decoding: speed, error, memory, bytes", "## Scenes", _SCENES_TEXT, scenes.table("scene")]
    parts += ["## Speed and error", _SPEED_TEXT, _truth_text(rows.select(section="truth")), "![](speed.png)"]
    parts += [speed.table("scene", "size", "decoder", across=["quantity", "threads"])]
    if not made.quick:
        parts += ["## The scene decoder's goals", _GOAL_TEXT, _goal_table(Readings([*scenes, *speed, *files]))]
    parts += ["## Error against time", _SWEEP_TEXT, "![](error-against-time.png)"]
    parts += [errors.table("scene", "decoder", "cutoff")]
    kinds = [Readings(row for row in files if (row.quantity in OPENING) is opens) for opens in (False, True)]
    parts += ["## Files and loading", _FILES_TEXT, kinds[0].table("scene", across=["decoder", "quantity"])]
    parts += [kinds[1].table("scene", "decoder", across=["quantity", "size"])]
    parts += ["## Peak memory", _MEMORY_TEXT, memory.table("scene", "size", across=["decoder"])]
    left_out = read_rows(folder / "left-out.csv", LeftOut)
    return [*parts, "## Left out by the decoders", _LEFT_OUT_TEXT, markdown(LeftOut._fields, left_out)]


@experiment("runs", report=report)
def run(output: Path, options: Options) -> None:
    """Race the decoders; the fits are kept."""
    subjects = [*decoders.standard_subjects(options.quick), *decoders.fitted_subjects(output, options)]
    with TemporaryDirectory() as folder:
        race = _Race(Path(folder), subjects, options.quick)
        rows = [row for step in with_progress(list(race.steps())) for row in step()]
        write_rows(output / "left-out.csv", LeftOut, race.left_out())
    write_rows(output / "results.csv", Row, [*(row for subject in subjects for row in _describe(subject)), *rows])
    missing = decoders.why_not_fitted(options)
    versions = "; ".join(f"{name} {version(name)}" for name in ("onnxruntime", "onnx", "onnx-ir"))
    waiting = f"OMP_WAIT_POLICY: {os.environ.get('OMP_WAIT_POLICY', 'not set')}"  # what torch's idle threads do
    notes = [f"{subject.name}: {subject.source}, contours {subject.contours}" for subject in subjects]
    notes += [] if missing is None else [f"Without fitted scenes: {missing}."]
    conclude(report, output, Made(options.command("decode"), options.quick, (versions, waiting), tuple(notes)))


def _describe(subject: Subject) -> list[Row]:
    (height, width), regions = subject.scene.size, subject.scene.regions
    values = {"height": height, "width": width, "N": len(subject.scene)}
    values["regions"] = 1 if regions is None else regions.num_regions
    return [Row("scenes", subject.name, "native", "", 1, 0.0, name, value, "1") for name, value in values.items()]


class _Race:
    """The scenes' files, and what is measured with them."""

    def __init__(self, folder: Path, subjects: list[Subject], quick: bool) -> None:
        self.folder, self.subjects, self.quick = folder, subjects, quick
        self.rounds = 1 if quick else 7
        # first, so that none is timed cold
        self.small = self._write("warm-up", decoders.small_scene(), DEFAULT_CUTOFF)
        self.files = {subject.name: self._write(subject.name, subject.scene, DEFAULT_CUTOFF) for subject in subjects}

    def steps(self) -> Iterator[tuple[str, Callable[[], list[Row]]]]:
        """List the measurements; memory first, then clocks, each of all scenes."""
        for subject in self.subjects[:1] if self.quick else self.subjects:
            for size in ("native",) if self.quick else FACTORS:
                yield f"memory {subject.name} {size}", partial(self._memory, subject, size)
        for subject in self.subjects:
            yield f"files {subject.name}", partial(self._files, subject)
            for size in FACTORS:
                yield f"speed {subject.name} {size}", partial(self._speed, subject, size)
        # several regions with hard contours, and what was fitted
        for subject in self.subjects:
            if subject.contours == "hard" or subject.is_fitted:
                yield f"error against time {subject.name}", partial(self._sweep, subject)
        # one of each kind of contours, the smallest: the dense sum takes its time
        for contours in decoders.CONTOURS:
            kind = [subject for subject in self.subjects if subject.contours == contours]
            subject = min(kind, key=lambda subject: len(subject.scene))
            yield f"truth {subject.name}", partial(_check_truth, subject)

    def left_out(self) -> Iterator[LeftOut]:
        """Read from decoders what they leave out."""
        import onnx

        paths = {(SCENE, name): files.decoder for name, files in self.files.items()}
        paths[GENERIC, ""] = self.small.generic
        for (decoder, name), path in paths.items():
            notes = {entry.key: entry.value for entry in onnx.load(path, load_external_data=False).metadata_props}
            yield from (LeftOut(decoder, name, sentence) for sentence in json.loads(notes["left_out"]))

    def _write(self, name: str, scene: Scene, cutoff: float) -> Files:
        return decoders.write_files(self.folder / name.replace(" ", "-"), scene, cutoff)

    def _memory(self, subject: Subject, size: str) -> list[Row]:
        rows = []
        for name in decoders.decoders_of(subject.scene):
            job, warm_up = (name, self.files[subject.name], _target(subject, size)), (name, self.small, (48, 64))
            peak = peak_bytes(partial, (decoders.open_and_render, *job), (decoders.open_and_render, *warm_up))
            rows.append(Row("memory", subject.name, size, name, 1, DEFAULT_CUTOFF, "peak", peak / 1e6, "MB"))
        return rows

    def _files(self, subject: Subject) -> list[Row]:
        files = self.files[subject.name]

        def row(size: str, name: str, quantity: str, value: float, unit: str) -> Row:
            return Row("files", subject.name, size, name, 1, DEFAULT_CUTOFF, quantity, value, unit)

        paths = {SCENE: files.decoder, GENERIC: files.generic, YARDSTICK: files.scene}
        rows = [row("native", name, "size", path.stat().st_size, "bytes") for name, path in paths.items()]
        rows.append(row("native", SCENE, "export", 1e3 * files.seconds, "ms"))
        for name in decoders.decoders_of(subject.scene):
            for size in FACTORS:
                taken = decoders.opening(name, files, _target(subject, size), 1 if self.quick else 3)
                rows += [row(size, name, quantity, 1e3 * value, "ms") for quantity, value in taken.items()]
        return rows

    def _speed(self, subject: Subject, size: str) -> list[Row]:
        """Time all decoders in turns, on one thread and on two, and take their errors."""
        files, target = self.files[subject.name], _target(subject, size)
        renders = {
            Entrant(name, count, DEFAULT_CUTOFF): decoders.open_decoder(name, files, target, count)
            for count in THREADS
            for name in decoders.decoders_of(subject.scene)
        }
        rows = _raced("speed", subject.name, size, renders, self.rounds)
        alone = {entrant: render for entrant, render in renders.items() if entrant.threads == 1}
        return rows + _errors("speed", subject.name, size, alone, truth(subject.scene, target))

    def _sweep(self, subject: Subject) -> list[Row]:
        """Take time and error at every cutoff, on one thread, all in turns."""
        renders: dict[Entrant, Render] = {}
        for cutoff in CUTOFFS:
            files = self._write(f"{subject.name} {cutoff:.3g}", subject.scene, cutoff)
            renders |= {
                Entrant(name, 1, cutoff): decoders.open_decoder(name, files, subject.scene.size, 1) for name in SWEPT
            }
        rows = _raced("error", subject.name, "native", renders, self.rounds)
        return rows + _errors("error", subject.name, "native", renders, truth(subject.scene, subject.scene.size))


def _target(subject: Subject, size: str) -> tuple[int, int]:
    height, width = subject.scene.size
    return FACTORS[size] * height, FACTORS[size] * width


def _raced(section: str, scene: str, size: str, renders: dict[Entrant, Render], rounds: int) -> list[Row]:
    seconds, rows = decoders.race(renders, rounds), []
    for entrant, values in seconds.items():
        row = partial(Row, section, scene, size, *entrant)
        rows.append(row("time", 1e3 * statistics.median(values), "ms"))
        rows.append(row("to cpu", median_ratio(values, seconds[entrant._replace(decoder=YARDSTICK)]), "1"))
    return rows


def _errors(section: str, scene: str, size: str, renders: dict[Entrant, Render], exact: Tensor) -> list[Row]:
    rows = []
    for entrant, render in renders.items():
        with threads(entrant.threads):
            error = (render().double() - exact).abs()
        row = partial(Row, section, scene, size, *entrant)
        rows += [row("max error", float(error.max()), "1"), row("rms error", float(error.square().mean().sqrt()), "1")]
    return rows


def _check_truth(subject: Subject) -> list[Row]:
    scene = subject.scene
    difference = float((truth(scene, scene.size) - truth(scene, scene.size, dense=True)).abs().max())
    return [Row("truth", subject.name, "native", "torch, reference", 1, 0.0, "difference", difference, "1")]


def cutoff_name(value: float) -> str:
    """Write a cutoff as people do."""
    return "1/255" if math.isclose(value, 1 / 255, rel_tol=1e-3) else f"{value:.0e}".replace("e-0", "e-")


def _truth_text(rows: Readings) -> str:
    differences = ", ".join(f"{number(row.value)} ({row.scene})" for row in rows)
    return (
        f"The truth is the `tiled` kernel in float64 at a cutoff of {decoders.TRUTH_CUTOFF:.0e}. From `reference`, the "
        f"dense sum in float64 at cutoff 0, it differs by at most {differences}."
    )


def _goal_table(rows: Readings) -> str:
    lines = []
    for name in rows.names("scene"):
        found = rows.select(scene=name, size="native", threads=1)
        # a fit has a few Gaussians fewer than it was asked for
        goals = {"time": 10.0 if found.value(quantity="N") <= 1_250 else 16.0, "to cpu": 3.0, "load": 500.0, RATIO: 2.5}
        values = {quantity: found.value(quantity=quantity, decoder=SCENE) for quantity in goals}
        cells = [f"{number(values[q])} ({'met' if values[q] <= goals[q] else 'missed'})" for q in goals]
        lines.append([name, *cells])
    return markdown(["scene", "ms", "to cpu", "load, ms", RATIO], lines)


def _plot_sweep(rows: Readings, path: Path) -> None:
    """Show the largest error against milliseconds, a panel for each scene, a line for each decoder."""
    scenes = rows.names("scene")
    cols = min(2, len(scenes))
    lines = math.ceil(len(scenes) / cols)
    plot, axes = figure(lines, cols, width=9.5, height=0.4 + 3.4 * lines)
    panels = list(axes.flat) if lines * cols > 1 else [axes]
    for axis, scene in zip(panels, scenes, strict=False):
        for name in rows.names("decoder"):
            line = rows.select(scene=scene, decoder=name)
            line.plot(axis, "cutoff", "time", "max error", annotate=True, **_style(name))
        axis.set(xlabel="milliseconds, one thread", ylabel="max error")
        _plain_ticks(axis)
        axis.set_title(f"{scene}; points: cutoff")
    for axis in panels[len(scenes) :]:
        axis.set_axis_off()
    plot.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(DECODERS))
    save_figure(plot, path)


def _plot_speed(rows: Readings, path: Path) -> None:
    """Show milliseconds by scene and decoder, native and enlarged; filled marks are one thread, hollow ones two."""
    scenes, sizes = rows.names("scene"), rows.names("size")
    plot, axes = figure(1, len(sizes), width=9.5, height=1.6 + 0.3 * len(scenes))
    for axis, size in zip(axes, sizes, strict=True):
        for name in rows.names("decoder"):
            for n, fill in ((1, "full"), (2, "none")):
                line = rows.select(size=size, decoder=name, threads=n, quantity="time")
                y = [scenes.index(row.scene) for row in line]
                style = {**_style(name), **({} if n == 1 else {"label": None})}
                axis.plot([row.value for row in line], y, linestyle="none", fillstyle=fill, **style)
        axis.set(xlabel=f"milliseconds, {size}", xscale="log", yticks=range(len(scenes)), yticklabels=scenes)
        _plain_ticks(axis)
        axis.invert_yaxis()
    axes[0].set_title("filled: one thread; hollow: two")
    plot.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(DECODERS))
    save_figure(plot, path)


def _style(decoder: str) -> dict[str, Any]:
    index = DECODERS.index(decoder)
    return {"color": COLORS[index], "marker": _MARKERS[index], "label": decoder}


def _plain_ticks(axis: Any) -> None:
    """Label milliseconds as numbers, at 1, 2 and 5 of each power of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
