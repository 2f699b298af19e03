"""How fast and how exactly each backend renders: `python -m benchmarks render`."""

from __future__ import annotations

import copy
import math
import statistics
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from kcgs.plots import figure, save_figure
from kcgs.scene import Scene

from . import _render_runs as runs
from ._decoders import fitted_subjects
from ._workloads import FITTED, SIZES, STANDARD, WIDE, needles, resized, standard, target_size, workload
from .core.clocks import in_turns, median_ratio, peak_bytes, threads
from .core.jobs import with_progress
from .core.options import Options
from .core.readings import Readings
from .core.registry import experiment
from .core.report import Made, conclude
from .core.rows import read_rows, write_rows

CUTOFFS = (1 / 255, 1e-3, 1e-4, 1e-6, 0.0)
DEFAULT_CUTOFF = 1e-4
SPEED_CUTOFFS = (1 / 255, DEFAULT_CUTOFF)
# the dense reference is timed where it takes seconds
DENSE = ("W3",)
# of a needle's thin axis
SIGMAS = (0.05, 0.5, 5.0)
ANISOTROPIES = (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)

_SPEED_TEXT = """Milliseconds, medians; through `region_splat` and autograd. Coverage is 12 Gaussians per pixel (3
sigma), with 6 regions. W3 is 200x300 with 20 Gaussians, W1 480x854 with 1,250, W2 480x854 with 7,500, W4 2160x3840
with 50,000. `to cpu` is the ratio of sums on one thread. `pair-list autograd` is plain torch, on one thread; where it
is missing it needs too much memory."""
_ACROSS = ("quantity", "threads")
_OVERHEAD_TEXT = """What the module, the operator and autograd add to the time of the `cpu` kernel alone: runs in turns
on one thread, of each the lower quartile, since other programs only add."""
_GRIDS_TEXT = """The `cpu` kernel with its coarse grids for wide Gaussians and, `cpu, direct`, without them, at a cutoff
of 1e-4: one image (forward), or one and its gradients (sum); medians, both in turns in one process. `speed-up` is the
median of the ratios of direct to this in the same round. A pair is a Gaussian and a pixel of the image, or a node of
the Gaussian's grid, where its weight before that of its region is at least the cutoff; all pairs are divided by the
pixels of the image. Errors are against the `tiled` kernel in float64 without coarse grids at a cutoff of 1e-12: of the
image, colours in [0, 1], and of gradients relative to the largest of their tensor. W1 to W4 are sums of 12 Gaussians of
about one size, with hard contours; the others are fitted scenes of the zoo, each with its own soft contours and with
hard ones of the same map."""
_MEMORY_TEXT = """MiB added by rendering one image and its gradients or, at 3840 wide, one image, in a process of its
own."""
_ERROR_TEXT = """One thread. Largest errors against the float64 reference at cutoff 0: of the image, and of the
gradients of means, cholesky and colors, relative to the largest gradient."""
_GROWTH_TEXT = """Forward and backward, one thread: N Gaussians of one size on 480x854, and images of more pixels with
N in proportion. Exponents are fitted to time over N and over pixels; 1 is a constant cost for each."""
_STIFFNESS_TEXT = """37 needles of one shape, turned from 0 to 180 degrees, in float32 at cutoff 0 against float64.
Image error relative to a colour of 1; gradient error relative to the largest of its component."""


class Row(NamedTuple):
    """One measured number."""

    section: str
    case: str
    backend: str
    threads: int
    quantity: str
    value: float
    unit: str


def report(folder: Path, made: Made) -> list[str]:
    """Write the figure, and return the parts of the report."""
    rows = Readings(read_rows(folder / "results.csv", Row))
    speed, memory, errors, growth, stiffness = (
        rows.select(section=name) for name in ("speed", "memory", "error", "growth", "stiffness")
    )
    for row in speed.select(quantity="sum", threads=1):
        ratio = row.value / speed.value(case=row.case, backend="cpu", threads=1, quantity="sum")
        speed.append(row._replace(quantity="to cpu", value=ratio, unit="1"))
    _plot_errors(errors, folder / "error-against-time.png")
    parts = ["# Rendering: speed, error, stability", "## Speed", _SPEED_TEXT]
    parts += [speed.table("case", "backend", across=_ACROSS)]
    if grids := rows.select(section="grids"):
        parts += ["## Coarse grids", _GRIDS_TEXT, grids.table("case", "backend", across=_ACROSS)]
    if overhead := rows.select(section="overhead"):
        parts += ["## Overhead of the module", _OVERHEAD_TEXT, overhead.table("case")]
    parts += ["## Peak memory", _MEMORY_TEXT, memory.table("backend", across=["case"])]
    parts += ["## Error against run time", _ERROR_TEXT, "![](error-against-time.png)", errors.table("backend", "case")]
    parts += ["## Growth", _GROWTH_TEXT, growth.table("case", across=["backend", "quantity"])]
    return [*parts, "## Stiffness", _STIFFNESS_TEXT, stiffness.table("case", across=["backend", "quantity"])]


@experiment("runs", report=report)
def run(output: Path, options: Options) -> None:
    """Measure speed, coarse grids, overhead, memory, error against run time, growth and stiffness; fits are kept."""
    quick = options.quick
    rounds = 1 if quick else 5
    names = ("W3",) if quick else ("W3", "W1", "W2", "W4")
    fitted = [f"{name} {contours}" for name in FITTED for contours in ("soft", "hard")]
    gridded = {name: standard(name) for name in (*names, *(fitted[:1] if quick else fitted))}
    gridded |= {} if quick else {subject.name: subject.scene for subject in fitted_subjects(output, options)}
    sizes = SIZES[:2] if quick else SIZES
    grids = [(name, scene, size) for name, scene in gridded.items() for size in (sizes if name != "W4" else SIZES[:1])]
    steps: list[tuple[str, Callable[[], list[Row]]]] = [
        *((f"speed {name}", partial(_speed, name, rounds)) for name in names),
        *((f"coarse grids {name}, {size}", partial(_grids, name, scene, size, rounds)) for name, scene, size in grids),
        *((f"overhead {name}", partial(_overhead, name)) for name in names),
        # last, since it leaves a gigabyte of memory in pieces behind it
        *((f"{runs.PEER} {name}", partial(_peer_speed, name, rounds)) for name in names),
        *((f"memory {name}", partial(_memory, name)) for name in (names if quick else (*names[1:], *fitted[::2]))),
        *((f"memory {name}", partial(_memory, name, WIDE)) for name in ([] if quick else fitted[::2])),
        *((f"error {name}", partial(_errors, name, rounds)) for name in (names if quick else ("W1", fitted[2]))),
        ("growth", partial(_growth, rounds, quick)),
        ("stiffness", _stiffness),
    ]
    rows = [row for step in with_progress(steps) for row in step()]
    write_rows(output / "results.csv", Row, rows)
    conclude(report, output, Made(options.command("render"), quick))


def _case(name: str, cutoff: float) -> str:
    return f"{name} cutoff {cutoff:.2g}"


def _timed(name: str, cutoff: float, backend: str, count: int, rounds: int) -> list[Row]:
    with threads(count):
        timings = runs.timed(backend, standard(name), cutoff, rounds)
    medians = {q: 1e3 * statistics.median(getattr(t, q) for t in timings) for q in ("forward", "backward", "sum")}
    row = partial(Row, "speed", _case(name, cutoff), backend, count)
    return [row(quantity, value, "ms") for quantity, value in medians.items()]


def _speed(name: str, rounds: int) -> list[Row]:
    backends = [*runs.backends(), *(["reference"] if name in DENSE else [])]
    cases = product(SPEED_CUTOFFS, backends, (1, 2))
    return [row for cutoff, backend, count in cases for row in _timed(name, cutoff, backend, count, rounds)]


def _grids(name: str, scene: Scene, size: str, rounds: int) -> list[Row]:
    """Time with coarse grids and without in turns, count pairs, and take errors; with gradients at native size."""
    is_native = size == "native"
    scene = scene if is_native else resized(scene, target_size(scene, size))
    row, rows = partial(Row, "grids", f"{name}, {size}"), []
    todo = {"forward": runs.forward, "sum": runs.both} if is_native else {"forward": runs.forward}
    actions = {
        (quantity, backend): partial(runs.second, partial(action, backend, scene, DEFAULT_CUTOFF))
        for quantity, action in todo.items()
        for backend in ("cpu", runs.DIRECT)
    }
    for count in (1, 2):
        with threads(count):
            seconds = in_turns(actions, rounds)
        for (quantity, backend), values in seconds.items():
            ratio = median_ratio(seconds[quantity, runs.DIRECT], values)
            rows.append(row(backend, count, quantity, 1e3 * statistics.median(values), "ms"))
            rows.append(row(backend, count, f"{quantity} speed-up", ratio, "1"))
    compute = runs.both if is_native else runs.forward
    want, want_gradients = compute(runs.EXACT, copy.deepcopy(scene).double(), runs.TRUTH_CUTOFF)
    for backend in ("cpu", runs.DIRECT):
        image, gradients = compute(backend, scene, DEFAULT_CUTOFF)
        rows.append(row(backend, 1, "image max", _largest(image - want), "1"))
        if is_native:
            rows.append(row(backend, 1, "gradient max", _gradient_error(gradients, want_gradients), "1"))
        rows.append(row(backend, 1, "pairs per pixel", runs.pairs_per_pixel(backend, scene, DEFAULT_CUTOFF), "1"))
    return rows


def _overhead(name: str) -> list[Row]:
    scene = standard(name)
    with threads(1):
        kernel, module = runs.in_turns(scene, DEFAULT_CUTOFF, max(5, 20_000_000 // math.prod(scene.size)))
    row = partial(Row, "overhead", _case(name, DEFAULT_CUTOFF), "cpu", 1)

    def added(quantity: str) -> float:
        around, alone = (float(np.quantile([getattr(t, quantity) for t in times], 0.25)) for times in (module, kernel))
        return 100 * (around / alone - 1)

    return [row(quantity, added(quantity), "%") for quantity in ("forward", "sum")]


def _peer_speed(name: str, rounds: int) -> list[Row]:
    cutoffs = [cutoff for cutoff in SPEED_CUTOFFS if runs.peer_fits(standard(name), cutoff)]
    return [row for cutoff in cutoffs for row in _timed(name, cutoff, runs.PEER, 1, rounds)]


def _memory(name: str, size: str = "native") -> list[Row]:
    rows = []
    case = name if size == "native" else f"{name}, {size}"
    backends = ["cpu", runs.DIRECT, *(["tiled"] if size == "native" else [])]
    backends += [runs.PEER] if name in STANDARD and runs.peer_fits(standard(name), DEFAULT_CUTOFF) else []
    for backend in backends:
        peak = peak_bytes(runs.prepare, (backend, name, DEFAULT_CUTOFF, size), (backend, "W3", DEFAULT_CUTOFF))
        rows.append(Row("memory", case, backend, 1, "peak", peak / 2**20, "MiB"))
    return rows


def _errors(name: str, rounds: int) -> list[Row]:
    scene, rows = standard(name), []
    _, want, want_gradients = runs.once(runs.renderer("reference"), copy.deepcopy(scene).double(), 0.0)
    for cutoff in CUTOFFS:
        actions = {
            backend: partial(runs.second, partial(runs.both, backend, scene, cutoff))
            for backend in ("cpu", runs.DIRECT, *runs.backends()[1:])
        }
        with threads(1):
            for backend, seconds in in_turns(actions, rounds).items():
                _, image, gradients = runs.once(runs.renderer(backend), scene, cutoff)
                row = partial(Row, "error", _case(name, cutoff), backend, 1)
                rows += [
                    row("sum", 1e3 * statistics.median(seconds), "ms"),
                    row("image max", _largest(image - want), "1"),
                    row("gradient max", _gradient_error(gradients, want_gradients), "relative to the largest"),
                ]
    return rows


def _gradient_error(found: list[Tensor], want: list[Tensor]) -> float:
    return max(_largest(f - w) / _largest(w) for f, w in zip(found, want, strict=True))


def _largest(values: Tensor) -> float:
    return float(values.abs().max())


def _growth(rounds: int, quick: bool) -> list[Row]:
    counts = (100, 400) if quick else (100, 400, 1_600, 6_400, 25_600)
    heights = (60, 120) if quick else (120, 240, 480, 960, 1_920)
    sizes = [(h, h * 16 // 9) for h in heights]
    grown = {
        "N": {n: workload(480, 854, n, spread=8.0) for n in counts},
        "pixels": {h * w: workload(h, w, max(1, h * h // 300)) for h, w in sizes},
    }
    rows = []
    for axis, scenes in grown.items():
        for backend in runs.backends():
            with threads(1):
                timings = [runs.timed(backend, scene, DEFAULT_CUTOFF, rounds) for scene in scenes.values()]
            seconds = [statistics.median(timing.sum for timing in found) for found in timings]
            for number, value in zip(scenes, seconds, strict=True):
                rows.append(Row("growth", f"{axis} = {number:,}", backend, 1, "sum", 1e3 * value, "ms"))
            slope = float(np.polyfit(np.log(list(scenes)), np.log(seconds), 1)[0])
            rows.append(Row("growth", axis, backend, 1, "exponent", slope, "1"))
    return rows


def _stiffness() -> list[Row]:
    """Hold needles turned through all angles against float64."""
    rows = []
    for sigma in SIGMAS:
        for anisotropy in ANISOTROPIES:
            scene = needles(sigma, anisotropy)
            _, want, want_gradients = runs.once(runs.renderer("reference"), copy.deepcopy(scene).double(), 0.0)
            for backend in [*runs.backends(), "reference"]:
                _, image, gradients = runs.once(runs.renderer(backend), scene, 0.0)
                worst = max(_by_component(g, w) for g, w in zip(gradients, want_gradients, strict=True))
                row = partial(Row, "stiffness", f"sigma {sigma:g} anisotropy {anisotropy:g}", backend, 1)
                rows += [row("image", _largest(image - want), "1"), row("gradient", worst, "relative to the largest")]
    return rows


def _by_component(got: Tensor, want: Tensor) -> float:
    # a needle's two directions differ by its anisotropy
    return float(((got - want).abs() / want.abs().amax(0).clamp_min(1e-12)).max())


def _plot_errors(rows: Readings, path: Path) -> None:
    """Show errors against milliseconds: a row of panels for each scene, a line for each backend."""
    named = Readings(row._replace(section=row.case.partition(" cutoff ")[0], case=row.case.split()[-1]) for row in rows)
    scenes = named.names("section")
    plot, axes = figure(len(scenes), 2, width=9.5, height=3.8 * len(scenes))
    for (scene, quantity), axis in zip(product(scenes, ("image max", "gradient max")), np.ravel(axes), strict=True):
        for name in named.names("backend"):
            line = named.select(section=scene, backend=name)
            line.plot(axis, "case", "sum", quantity, marker="o", label=name)
        axis.set(
            xlabel="milliseconds, forward and backward", ylabel=f"{quantity} error", title=f"{scene}; points: cutoff"
        )
        axis.legend()
    save_figure(plot, path)
