"""How fast and how exactly a scene is rendered by each of its decoders: `kcgs bench decode`."""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from torch import Tensor

from kcgs.scene import Scene

from . import _decoders as decoders
from ._decode_report import LeftOut, Row, SceneRow, report
from ._decoders import CPU, GENERIC, SCENE, TILED, YARDSTICK, Files, Subject, truth
from .core.clocks import clock, in_turns, median_ratio, peak_bytes, threads
from .core.jobs import with_progress
from .core.options import Options
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import write_rows

CUTOFFS = (1e-2, 1 / 255, 1e-3, 1e-4, 1e-6)
DEFAULT_CUTOFF = 1e-4
THREADS = (1, 2)
FACTORS = {"native": 1, "2x": 2}
SWEPT = (SCENE, CPU, TILED)

Render = Callable[[], Tensor]


class Entrant(NamedTuple):
    """Who runs: a decoder, its threads, its cutoff."""

    decoder: str
    threads: int
    cutoff: float


@experiment("runs", report=report)
def run(output: Path, options: Options) -> None:
    """Race the decoders; the fits are kept."""
    subjects = [*decoders.standard_subjects(options.quick), *decoders.fitted_subjects(output, options)]
    with TemporaryDirectory() as folder:
        race = _Race(Path(folder), subjects, options.quick)
        write_rows(output / "results.csv", Row, [row for step in with_progress(list(race.steps())) for row in step()])
        write_rows(output / "left-out.csv", LeftOut, race.left_out())
    write_rows(output / "scenes.csv", SceneRow, map(_describe, subjects))
    missing = decoders.why_not_fitted(options)
    versions = "; ".join(f"{name} {version(name)}" for name in ("onnxruntime", "onnx", "onnx-ir"))
    waiting = f"OMP_WAIT_POLICY: {os.environ.get('OMP_WAIT_POLICY', 'not set')}"  # what torch's idle threads do
    notes = () if missing is None else (f"Without fitted scenes: {missing}.",)
    conclude(report, output, Made(options.command("decode"), options.quick, (versions, waiting), notes))


def _describe(subject: Subject) -> SceneRow:
    scene, regions = subject.scene, subject.scene.regions
    count = 1 if regions is None else regions.num_regions
    return SceneRow(subject.name, *scene.size, len(scene), count, subject.contours, subject.source)


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

        paths = {(SCENE, name): files.decoder for name, files in self.files.items()} | {
            (GENERIC, ""): self.small.generic
        }
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
                taken = opening(name, files, _target(subject, size), 1 if self.quick else 3)
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


def race(renders: Mapping[Entrant, Render], rounds: int) -> dict[Entrant, list[float]]:
    """Time rendering in turns; seconds of each round.

    Each renders twice in its turn, and the second counts: the first finds the caches, and maybe a processor, still
    taken by the one before.
    """

    def second(entrant: Entrant) -> float:
        with threads(entrant.threads):
            renders[entrant]()
            return clock(renders[entrant])

    return in_turns({entrant: partial(second, entrant) for entrant in renders}, rounds)


def opening(name: str, files: Files, size: tuple[int, int], rounds: int) -> dict[str, float]:
    """Time a decoder from its files, on one thread: until ready to render, and until the first image is there.

    Returns:
        Medians in seconds after one run to warm up.
    """
    runs = []
    with threads(1):
        for _ in range(rounds + 1):
            opened: list[Render] = []
            load = clock(lambda: opened.append(decoders.open_decoder(name, files, size, 1)))  # noqa: B023
            runs.append((load, load + clock(opened[0])))
    return dict(zip(("load", "first image"), map(statistics.median, zip(*runs[1:], strict=True)), strict=True))


def _target(subject: Subject, size: str) -> tuple[int, int]:
    height, width = subject.scene.size
    return FACTORS[size] * height, FACTORS[size] * width


def _raced(section: str, scene: str, size: str, renders: dict[Entrant, Render], rounds: int) -> list[Row]:
    seconds, rows = race(renders, rounds), []
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
