"""How fast and how exactly a scene is rendered by each of its decoders: `python -m benchmarks decode`."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from itertools import product, zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from torch import Tensor

from kcgs.plots import COLORS, figure, save_figure
from kcgs.scene import Scene

from . import _decoders as decoders
from ._decoders import CPU, CPU_DIRECT, DECODERS, GENERIC, SCENE, SCENE_DIRECT, TILED, Entrant, Files, Render, Subject
from ._workloads import SIZES, target_size, workload
from .core.clocks import median_ratio, peak_bytes, threads
from .core.figures import MARKERS, add_legend
from .core.jobs import with_progress
from .core.options import Options
from .core.readings import Readings
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows

CUTOFFS = (1e-2, 1 / 255, 1e-3, 1e-4, 1e-6)
DEFAULT_CUTOFF = 1e-4
THREADS = (1, 2)
SWEPT = (SCENE, SCENE_DIRECT, CPU, CPU_DIRECT, TILED)

_SPEED_TEXT = """Milliseconds for one image, medians; all decoders of a scene are timed in turns in one process, on
one thread and on two, at the default cutoff of 1e-4. `to cpu` is the median of the ratios to torch's `cpu` kernel on
as many threads in the same round. torch's kernels and the generic decoder are given the Gaussians scaled and the
label map sampled for the size that is rendered, once for all images; the scene decoder does both in every image.
`direct` is without coarse grids. At 3840 wide only the fast ones run. Errors are against the
`tiled` kernel in float64 without coarse grids at a cutoff of 1e-12, colours in [0, 1]; values of the workloads' images
go up to about 5, since they are sums of 12 Gaussians."""
_SWEEP_TEXT = "One thread, the scene's own size; all timed in turns. Left and below is better."
_FILES_TEXT = """`bytes to scene` is the size of the scene decoder over that of the scene, which torch reads. The
generic decoder is one file for all scenes and needs the scene beside it. Loading, in milliseconds, goes from the files
on disk to being ready to render, onnxruntime's optimisation of the graph, scaling and sampling the label map included.
One thread, medians."""
_MEMORY_TEXT = """MB added at the peak by loading and rendering one image, on one thread, each in a process of its own
that has rendered a small scene before."""


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


def report(folder: Path, made: Made) -> list[str]:
    """Write the figure, and return the parts of the report."""
    rows = Readings(read_rows(folder / "results.csv", Row))
    speed, files, load, memory = (rows.select(section=name) for name in ("speed", "files", "load", "memory"))
    for row in files.select(decoder=SCENE, quantity="size"):
        ratio = row.value / files.value(scene=row.scene, decoder=CPU, quantity="size")
        files.append(row._replace(quantity="bytes to scene", value=ratio, unit="1"))
    errors = Readings(row._replace(cutoff=cutoff_name(row.cutoff)) for row in rows.select(section="error"))
    _plot_sweep(errors, folder / "error-against-time.png")
    parts = ["# Decoding: speed, error, memory, bytes", "## Speed and error", _SPEED_TEXT]
    parts += [speed.table("scene", "size", "decoder", across=["quantity", "threads"])]
    parts += ["## Error against time", _SWEEP_TEXT, "![](error-against-time.png)"]
    parts += [errors.table("scene", "decoder", "cutoff")]
    parts += ["## Files and loading", _FILES_TEXT, files.table("scene", across=["decoder", "quantity"])]
    parts += [load.table("scene", "size", across=["decoder"])]
    return [*parts, "## Peak memory", _MEMORY_TEXT, memory.table("scene", "size", across=["decoder"])]


@experiment("runs", report=report)
def run(output: Path, options: Options) -> None:
    """Race the decoders; the fits are kept."""
    subjects = [*decoders.standard_subjects(options.quick), *([] if options.quick else decoders.zoo_subjects())]
    subjects += decoders.fitted_subjects(output, options)
    with TemporaryDirectory() as folder:
        race = _Race(Path(folder), subjects, options.quick)
        rows = [row for step in with_progress(list(race.steps())) for row in step()]
    write_rows(output / "results.csv", Row, rows)
    missing = decoders.why_not_fitted(options)
    versions = "; ".join(f"{name} {version(name)}" for name in ("onnxruntime", "onnx", "onnx-ir"))
    waiting = f"OMP_WAIT_POLICY: {os.environ.get('OMP_WAIT_POLICY', 'not set')}"  # what torch's idle threads do
    notes = [f"{subject.name}: {subject.about}" for subject in subjects]
    notes += [] if missing is None else [f"Without fitted scenes: {missing}."]
    conclude(report, output, Made(options.command("decode"), options.quick, (versions, waiting), tuple(notes)))


class _Race:
    """The scenes' files, and what is measured with them."""

    def __init__(self, folder: Path, subjects: list[Subject], quick: bool) -> None:
        self.folder, self.subjects, self.quick = folder, subjects, quick
        self.rounds = 1 if quick else 7
        self.sizes = SIZES[:1] if quick else SIZES
        # first, so that none is timed cold
        self.small = self._write("warm-up", workload(48, 64, 40), DEFAULT_CUTOFF)
        self.files = {subject.name: self._write(subject.name, subject.scene, DEFAULT_CUTOFF) for subject in subjects}

    def steps(self) -> Iterator[tuple[str, Callable[[], list[Row]]]]:
        """List the measurements: memory first, then clocks."""
        for subject in self.subjects[:1] if self.quick else [s for s in self.subjects if s.is_typical]:
            for size in self.sizes[:1] if self.quick else self.sizes:
                yield f"memory {subject.name} {size}", partial(self._memory, subject, size)
        for subject in self.subjects:
            yield f"files {subject.name}", partial(self._files, subject)
            for size in self.sizes:
                yield f"speed {subject.name} {size}", partial(self._speed, subject, size)
        for subject in self.subjects:
            if subject.is_typical:
                yield f"error against time {subject.name}", partial(self._sweep, subject)

    def _write(self, name: str, scene: Scene, cutoff: float) -> Files:
        return decoders.write_files(self.folder / name.replace(" ", "-"), scene, cutoff)

    def _memory(self, subject: Subject, size: str) -> list[Row]:
        rows = []
        for name in decoders.decoders_of(subject.scene, size):
            job, warm_up = (self.files[subject.name], target_size(subject.scene, size)), (self.small, (48, 64))
            peak = peak_bytes(partial, *((decoders.open_and_render, name, *rest) for rest in (job, warm_up)))
            rows.append(Row("memory", subject.name, size, name, 1, DEFAULT_CUTOFF, "peak", peak / 1e6, "MB"))
        return rows

    def _files(self, subject: Subject) -> list[Row]:
        files, row = self.files[subject.name], partial(Row, scene=subject.name, threads=1, cutoff=DEFAULT_CUTOFF)
        rows = [
            row(section="files", size="native", decoder=name, quantity="size", value=path.stat().st_size, unit="bytes")
            for name, path in {SCENE: files.decoder, GENERIC: files.generic, CPU: files.scene}.items()
        ]
        entrants = [name for name in decoders.decoders_of(subject.scene) if name not in (SCENE_DIRECT, CPU_DIRECT)]
        for name, size in product(entrants, SIZES[:2]):
            seconds = decoders.load_seconds(name, files, target_size(subject.scene, size), 1 if self.quick else 3)
            rows.append(row(section="load", size=size, decoder=name, quantity="load", value=1e3 * seconds, unit="ms"))
        return rows

    def _speed(self, subject: Subject, size: str) -> list[Row]:
        """Time all decoders in turns, on one thread and on two, and take their errors."""
        files, target = self.files[subject.name], target_size(subject.scene, size)
        renders = {
            Entrant(name, count, DEFAULT_CUTOFF): decoders.open_decoder(name, files, target, count)
            for count in THREADS
            for name in decoders.decoders_of(subject.scene, size)
        }
        rows = _raced("speed", subject.name, size, renders, self.rounds)
        alone = {entrant: render for entrant, render in renders.items() if entrant.threads == 1}
        return rows + _errors("speed", subject.name, size, alone, decoders.truth(subject.scene, target))

    def _sweep(self, subject: Subject) -> list[Row]:
        """Take time and error at every cutoff, on one thread, all in turns."""
        renders: dict[Entrant, Render] = {}
        for cutoff in CUTOFFS:
            files = self._write(f"{subject.name} {cutoff:.3g}", subject.scene, cutoff)
            renders |= {
                Entrant(name, 1, cutoff): decoders.open_decoder(name, files, subject.scene.size, 1) for name in SWEPT
            }
        rows = _raced("error", subject.name, "native", renders, self.rounds)
        exact = decoders.truth(subject.scene, subject.scene.size)
        return rows + _errors("error", subject.name, "native", renders, exact)


def _raced(section: str, scene: str, size: str, renders: dict[Entrant, Render], rounds: int) -> list[Row]:
    seconds, rows = decoders.race(renders, rounds), []
    for entrant, values in seconds.items():
        row = partial(Row, section, scene, size, *entrant)
        rows.append(row("time", 1e3 * statistics.median(values), "ms"))
        rows.append(row("to cpu", median_ratio(values, seconds[entrant._replace(decoder=CPU)]), "1"))
    return rows


def _errors(section: str, scene: str, size: str, renders: dict[Entrant, Render], exact: Tensor) -> list[Row]:
    rows = []
    for entrant, render in renders.items():
        with threads(entrant.threads):
            error = (render().double() - exact).abs()
        row = partial(Row, section, scene, size, *entrant)
        rows += [row("max error", float(error.max()), "1"), row("rms error", float(error.square().mean().sqrt()), "1")]
    return rows


def cutoff_name(value: float) -> str:
    """Write a cutoff as people do."""
    return "1/255" if math.isclose(value, 1 / 255, rel_tol=1e-3) else f"{value:.0e}".replace("e-0", "e-")


def _plot_sweep(rows: Readings, path: Path) -> None:
    """Show the largest error against milliseconds, a panel for each scene, a line for each decoder."""
    scenes = rows.names("scene")
    lines = math.ceil(len(scenes) / 2)
    plot, axes = figure(lines, 2, width=9.5, height=0.4 + 3.4 * lines)
    for axis, scene in zip_longest(axes.flat, scenes):
        axis.set_visible(scene is not None)
        for name in rows.names("decoder"):
            index = DECODERS.index(name)
            style = {"color": COLORS[index], "marker": MARKERS[index], "label": name}
            rows.select(scene=scene, decoder=name).plot(axis, "cutoff", "time", "max error", **style)
        axis.set(xlabel="milliseconds, one thread", ylabel="max error", title=f"{scene}; points: cutoff")
    add_legend(plot, axes.flat[0], columns=len(DECODERS), where="upper")
    save_figure(plot, path)
