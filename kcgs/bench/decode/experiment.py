"""The measurements, in order, and what becomes of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from kcgs.bench.cells import write_csv
from kcgs.bench.render.timing import threads
from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .decoders import (
    CPU,
    DECODERS,
    GENERIC,
    SCENE,
    TILED,
    YARDSTICK,
    Draw,
    Files,
    can_draw,
    open_decoder,
    truth,
    write_files,
)
from .findings import Findings, Row
from .report import describe_files, write
from .scenes import Scene, fitted_scenes, standard_scenes, why_not_fitted
from .timing import Entrant, opening, peak_memory, race, ratio

CUTOFFS = (1e-2, 1 / 255, 1e-3, 1e-4, 1e-6)
DEFAULT_CUTOFF = 1e-4
THREADS = (1, 2)
FACTORS = {"native": 1, "2x": 2}
SWEPT = (SCENE, CPU, TILED)

Step = tuple[str, Callable[[], list[Row]]]


def run(output: Path, *, data: Path | None = None, quick: bool = False) -> None:
    """Race the decoders; write results.csv, report.md and figures.

    Args:
        output: folder; fitted scenes are kept in its folder `scenes`, so that the next run need not fit them again.
        data: folder with DAVIS in it; None: the scenes made by rule are all there is.
        quick: small scenes, one round.
    """
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    rows: list[Row] = []
    with TemporaryDirectory() as folder, Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("fits", total=None)
        scenes = [*standard_scenes(quick), *fitted_scenes(output / "scenes", data, quick)]
        bench = _Bench(Path(folder), scenes, quick)
        steps = list(bench.steps())
        progress.update(task, total=len(steps))
        for name, step in steps:
            progress.update(task, description=name)
            rows += step()
            progress.advance(task)
        findings = Findings(rows, scenes, describe_files(bench.files), why_not_fitted(data, quick), quick)
    write_csv(output / "results.csv", Row._fields, rows)
    write(output, findings)
    Console().print(f"{output}/report.md")


class _Bench:
    """The scenes' files, and what is measured with them."""

    def __init__(self, folder: Path, scenes: list[Scene], quick: bool) -> None:
        self.folder, self.scenes, self.quick = folder, scenes, quick
        self.repeats = 1 if quick else 7
        self.files: dict[str, Files] = {}
        self.build_seconds: dict[str, float] = {}
        self.small = write_files(self._path("warm-up"), _small(), DEFAULT_CUTOFF)  # first, so that none is timed cold
        for scene in scenes:
            start = time.perf_counter()
            self.files[scene.name] = write_files(self._path(scene.name), scene, DEFAULT_CUTOFF)
            self.build_seconds[scene.name] = time.perf_counter() - start

    def steps(self) -> Iterator[Step]:
        """List the measurements; memory first, then clocks, each of all scenes."""
        for scene in self.scenes[:1] if self.quick else self.scenes:
            for size in ("native",) if self.quick else FACTORS:
                yield f"memory {scene.name} {size}", partial(self._memory, scene, size)
        for scene in self.scenes:
            yield f"files {scene.name}", partial(self._files, scene)
            for size in FACTORS:
                yield f"speed {scene.name} {size}", partial(self._speed, scene, size)
                yield f"error {scene.name} {size}", partial(self._error, scene, size)
        for scene in self._swept():
            yield f"error against time {scene.name}", partial(self._sweep, scene)
        # one of each kind of contours, the smallest: the dense sum takes its time
        for contours in ("none", "hard", "soft"):
            scene = min((s for s in self.scenes if s.contours == contours), key=lambda s: len(s.field))
            yield f"truth {scene.name}", partial(_check_truth, scene)

    def _swept(self) -> list[Scene]:
        """Several regions with hard contours, and what was fitted."""
        standard = {s.name for s in standard_scenes(self.quick)}
        return [s for s in self.scenes if s.contours == "hard" or s.name not in standard]

    def _path(self, name: str) -> Path:
        return self.folder / name.replace(" ", "-")

    def _files(self, scene: Scene) -> list[Row]:
        files, row = self.files[scene.name], partial(Row, "files", scene.name, "native")
        rows = [
            row(name, 1, DEFAULT_CUTOFF, "size", path.stat().st_size, "bytes")
            for name, path in ((SCENE, files.decoder), (GENERIC, files.generic), (YARDSTICK, files.scene))
        ]
        rows.append(row(SCENE, 1, DEFAULT_CUTOFF, "export", 1e3 * self.build_seconds[scene.name], "ms"))
        for name in _entrants(scene):
            for size in FACTORS:
                took = opening(name, files, _target(scene, size), 1 if self.quick else 3)
                for quantity, seconds in zip(("load", "first picture"), took, strict=True):
                    rows.append(Row("files", scene.name, size, name, 1, DEFAULT_CUTOFF, quantity, 1e3 * seconds, "ms"))
        return rows

    def _memory(self, scene: Scene, size: str) -> list[Row]:
        target, files = _target(scene, size), self.files[scene.name]
        peaks = {name: peak_memory(name, files, target, self.small) for name in _entrants(scene)}
        row = partial(Row, "memory", scene.name, size)
        return [row(name, 1, DEFAULT_CUTOFF, "peak", peak, "MB") for name, peak in peaks.items()]

    def _speed(self, scene: Scene, size: str) -> list[Row]:
        files, target = self.files[scene.name], _target(scene, size)
        draws = {
            Entrant(name, n, DEFAULT_CUTOFF): open_decoder(name, files, target, n)
            for n in THREADS
            for name in _entrants(scene)
        }
        return _raced("speed", scene, size, draws, self.repeats)

    def _error(self, scene: Scene, size: str) -> list[Row]:
        target = _target(scene, size)
        exact = truth(scene, target)
        rows = []
        for name in _entrants(scene):
            draw = open_decoder(name, self.files[scene.name], target, 1)
            rows += _errors("speed", scene, size, Entrant(name, 1, DEFAULT_CUTOFF), draw, exact)
        return rows

    def _sweep(self, scene: Scene) -> list[Row]:
        """Time and error at every cutoff, on one thread, all in turns."""
        draws: dict[Entrant, Draw] = {}
        for cutoff in CUTOFFS:
            files = write_files(self._path(f"{scene.name} {cutoff:.3g}"), scene, cutoff)
            draws |= {Entrant(name, 1, cutoff): open_decoder(name, files, scene.size, 1) for name in SWEPT}
        exact = truth(scene, scene.size)
        rows = _raced("error", scene, "native", draws, self.repeats)
        return rows + [
            row for entrant, draw in draws.items() for row in _errors("error", scene, "native", entrant, draw, exact)
        ]


def _entrants(scene: Scene) -> list[str]:
    return [name for name in DECODERS if can_draw(name, scene)]


def _target(scene: Scene, size: str) -> tuple[int, int]:
    height, width = scene.size
    return FACTORS[size] * height, FACTORS[size] * width


def _raced(section: str, scene: Scene, size: str, draws: dict[Entrant, Draw], repeats: int) -> list[Row]:
    seconds = race(draws, repeats)
    rows = []
    for entrant, times in seconds.items():
        row = partial(Row, section, scene.name, size, *entrant)
        rows.append(row("time", 1e3 * statistics.median(times), "ms"))
        rows.append(row("to cpu", ratio(times, seconds[entrant._replace(decoder=YARDSTICK)]), "1"))
    return rows


def _errors(section: str, scene: Scene, size: str, entrant: Entrant, draw: Draw, exact: Tensor) -> list[Row]:
    with threads(entrant.threads):
        error = (draw().double() - exact).abs()
    row = partial(Row, section, scene.name, size, *entrant)
    return [row("max error", float(error.max()), "1"), row("rms error", float(error.square().mean().sqrt()), "1")]


def _check_truth(scene: Scene) -> list[Row]:
    difference = (truth(scene, scene.size) - truth(scene, scene.size, dense=True)).abs().max()
    return [Row("truth", scene.name, "native", "torch, reference", 1, 0.0, "difference", float(difference), "1")]


def _small() -> Scene:
    labels = (torch.arange(64) > 30).long().expand(48, 64)
    field = GaussianField.random(40, (48, 64), regions=labels, seed=0)
    return Scene("warm-up", "made by rule", field, RegionMap.from_labels(labels))
