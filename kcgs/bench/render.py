"""How fast and how exactly each backend renders: `kcgs bench render`."""

from __future__ import annotations

import copy
import statistics
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcgs.kernels.cpu import kernel
from kcgs.nn import RegionSplatRenderer
from kcgs.plots import COLORS, figure, save_figure

from . import _render_runs as runs
from ._workloads import needles, standard, workload
from .core.clocks import clock, in_turns, median_ratio, peak_bytes, threads
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
# of a needle's thin axis, and how the figure shows it
SIGMAS = {0.05: ":", 0.5: "--", 5.0: "-"}
ANISOTROPIES = (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
EXPONENT = "exponent of time in pairs"

_SPEED_TEXT = """Milliseconds, medians; through `region_splat` and autograd, validation included. Coverage is 12
Gaussians per pixel (3 sigma), with 6 regions. W3 is 200x300 with 20 Gaussians, W1 480x854 with 1,250, W2 480x854 with
7,500, W4 2160x3840 with 50,000. `limit` is the same arithmetic for the same pairs with nothing read and nothing
written; `to cpu` is the ratio of sums on one thread. The plain-torch peers run on one thread; where they are missing
they need too much memory."""
_LIMIT_TEXT = """Pairs are those of a pixel and a Gaussian that the kernel evaluates. Kernel and limit are timed in
turns; the kernel's share of the limit, and the gains of a second thread, are medians of the ratios of neighbouring
runs. The limit's own gain is what a second thread gives on this machine. Images per second are through
`RegionSplatRenderer`, without gradients."""
_OVERHEAD_TEXT = "The kernel alone, and through `RegionSplatRenderer` and autograd; forward and backward, one thread."
_MEMORY_TEXT = "MiB added by rendering one image and its gradients, in a process of its own."
_ERROR_TEXT = """One thread. Image error against the float64 reference at cutoff 0, colours in [0, 1]; gradient error
relative to the largest gradient (max) or the rms gradient (rms), the worst of means, cholesky and colors."""
_GROWTH_TEXT = """Forward and backward against evaluated pairs, one thread. An exponent of 1 is a constant cost per
pair; it is below 1 where the fixed costs of an image (filling and reading its pixels) weigh less as pairs grow."""
_STIFFNESS_TEXT = """37 needles of one shape, turned from 0 to 180 degrees, rendered in float32 at cutoff 0 against
float64. Image error relative to a colour of 1; gradient error relative to the largest of its component. The parameters
are the same float32 numbers on both sides: what is measured is the arithmetic."""


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
    """Write the figures, and return the parts of the report."""
    measured = Readings(read_rows(folder / "results.csv", Row))
    rows = Readings([*measured, *_derived(measured)])
    sections = {name: rows.select(section=name) for name in rows.names("section")}
    errors, growth, stiffness = (sections[name] for name in ("error", "growth", "stiffness"))
    _plot_error(errors, folder / "error-against-time.png")
    _plot_growth(growth, folder / "growth.png")
    _plot_stiffness(stiffness, folder / "stiffness.png")
    parts = ["# Rendering: speed, error, stability", "## Speed", _SPEED_TEXT]
    parts += [sections["speed"].table("case", "backend", across=["quantity", "threads"])]
    parts += ["## Against the limit of the processor", _LIMIT_TEXT]
    parts += [sections["limit"].table("case", across=["backend", "quantity", "threads"])]
    parts += ["## Overhead of the module", _OVERHEAD_TEXT, sections["overhead"].table("case")]
    parts += ["## Peak memory", _MEMORY_TEXT, sections["memory"].table("backend", across=["case"])]
    parts += ["## Error against run time", _ERROR_TEXT, "![](error-against-time.png)", errors.table("backend", "case")]
    parts += [
        "## Growth",
        _GROWTH_TEXT,
        "![](growth.png)",
        growth.select(quantity=EXPONENT).table("backend", across=["case"]),
    ]
    stiff = stiffness.table("case", across=["backend", "quantity"])
    return [*parts, "## Stiffness", _STIFFNESS_TEXT, "![](stiffness.png)", stiff]


def _derived(rows: Readings) -> Iterator[Row]:
    """Yield what follows from measured numbers: ratios to the CPU kernel, its rates, the module's overhead."""
    kernel = rows.select(section="speed", backend="cpu", threads=1)
    for row in rows.select(section="speed", quantity="sum", threads=1):
        ratio = row.value / kernel.value(case=row.case, quantity="sum")
        yield row._replace(quantity="to cpu", value=ratio, unit="1")
    for row in rows.select(section="limit", quantity="pairs"):
        for quantity in ("forward", "backward"):
            rate = row.value / kernel.value(case=row.case, quantity=quantity)
            yield row._replace(backend="cpu", quantity=quantity, value=rate, unit="Gpairs/s")
    for row in rows.select(section="overhead", quantity="kernel alone"):
        more = rows.value(section="overhead", case=row.case, quantity="module and autograd") / row.value - 1
        yield row._replace(quantity="more", value=100 * more, unit="%")


@experiment(report=report)
def run(output: Path, options: Options) -> None:
    """Measure speed, memory, error against run time, growth and stiffness."""
    quick = options.quick
    rounds = 1 if quick else 5
    names = ("W3",) if quick else ("W3", "W1", "W2", "W4")
    steps: list[tuple[str, Callable[[], list[Row]]]] = [
        # first, since peers leave a gigabyte of memory in pieces behind them
        *((f"kernel and limit {name}", partial(_beside_limit, name, 3 * rounds)) for name in names),
        *((f"speed {name}", partial(_speed, name, rounds)) for name in names),
        *((f"overhead {name}", partial(_overhead, name, 4 * rounds)) for name in names[:2]),
        *((f"memory {name}", partial(_memory, name)) for name in (names if quick else ("W1", "W2", "W4"))),
        ("error against run time", partial(_errors, "W3" if quick else "W1", rounds)),
        ("growth", partial(_growth, rounds, quick)),
        ("stiffness", _stiffness),
    ]
    rows = [row for step in with_progress(steps) for row in step()]
    write_rows(output / "results.csv", Row, rows)
    conclude(report, output, Made(options.command("render"), quick))


def _case(name: str, cutoff: float) -> str:
    return f"{name} cutoff {cutoff:.2g}"


def _timing_rows(case: str, backend: str, count: int, timings: list[runs.Timing]) -> list[Row]:
    medians = {q: 1e3 * statistics.median(getattr(t, q) for t in timings) for q in ("forward", "backward", "sum")}
    return [Row("speed", case, backend, count, quantity, value, "ms") for quantity, value in medians.items()]


def _beside_limit(name: str, rounds: int) -> list[Row]:
    """Time the CPU kernel and the limit in turns, on one thread and on two."""
    scene, rows = standard(name), []
    for cutoff in SPEED_CUTOFFS:
        pairs, case = runs.evaluated_pairs(scene, cutoff), _case(name, cutoff)

        def limit(count: int, pairs: int = pairs) -> runs.Timing:
            return runs.Timing(*(runs.limit_seconds(pairs, backward=kind, threads=count) for kind in (False, True)))

        def splat(count: int, cutoff: float = cutoff) -> runs.Timing:
            with threads(count):
                return runs.once(runs.renderer("cpu"), scene, cutoff)[0]

        pace = {"limit": limit, "cpu": splat}
        actions = {(who, n): partial(time_it, n) for n in (1, 2) for who, time_it in pace.items()}
        timings = {key: values[1:] for key, values in in_turns(actions, rounds + 1).items()}
        sums = {key: [timing.sum for timing in values] for key, values in timings.items()}
        rows.append(Row("limit", case, "limit", 1, "pairs", pairs / 1e6, "M"))
        for (who, n), values in timings.items():
            rows += _timing_rows(case, who, n, values)
        share = median_ratio(sums["limit", 1], sums["cpu", 1])
        rows.append(Row("limit", case, "cpu", 1, "share", share, "1"))
        gains = {who: median_ratio(sums[who, 1], sums[who, 2]) for who in pace}
        rows += [Row("limit", case, who, 2, "gain", gain, "1") for who, gain in gains.items()]
        rows.append(Row("limit", case, "cpu", 2, "images", runs.images_per_second(scene, cutoff, rounds), "1/s"))
    return rows


def _speed(name: str, rounds: int) -> list[Row]:
    scene, rows = standard(name), []
    for cutoff in SPEED_CUTOFFS:
        names = [*(b for b in runs.backends() if b != "cpu"), *(["reference"] if name in DENSE else [])]
        names += [peer for peer in runs.PEERS if runs.held_pairs(peer, scene, cutoff) <= runs.MOST_PAIRS]
        for backend in names:
            for count in (1,) if backend in runs.PEERS else (1, 2):
                with threads(count):
                    timings = runs.timed(backend, scene, cutoff, rounds)
                rows += _timing_rows(_case(name, cutoff), backend, count, timings)
    return rows


def _overhead(name: str, rounds: int) -> list[Row]:
    """Time the CPU kernel alone, and through the module and autograd, forward and backward."""
    scene = standard(name)
    inputs, probe = runs.kernel_inputs(scene, DEFAULT_CUTOFF), runs.probe_of(scene.size, 3, torch.float32)
    render = RegionSplatRenderer(cutoff=DEFAULT_CUTOFF, backend="cpu")

    def alone() -> None:
        planned = kernel.plan(inputs)
        kernel.render(planned, inputs)
        kernel.differentiate(planned, inputs, probe[None], geometry=True)

    def whole() -> None:
        scene.zero_grad(set_to_none=True)
        render(scene).backward(probe)

    actions = {"kernel alone": partial(clock, alone), "module and autograd": partial(clock, whole)}
    with threads(1):
        seconds = in_turns(actions, rounds + 1)
    medians = {quantity: 1e3 * statistics.median(values[1:]) for quantity, values in seconds.items()}
    return [Row("overhead", name, "cpu", 1, quantity, value, "ms") for quantity, value in medians.items()]


def _memory(name: str) -> list[Row]:
    scene, rows = standard(name), []
    for backend in ("cpu", "tiled", *runs.PEERS):
        if backend not in runs.PEERS or runs.held_pairs(backend, scene, DEFAULT_CUTOFF) <= runs.MOST_PAIRS:
            peak = peak_bytes(runs.prepare, (backend, name, DEFAULT_CUTOFF), (backend, "W3", DEFAULT_CUTOFF))
            rows.append(Row("memory", name, backend, 1, "peak", peak / 2**20, "MiB"))
    return rows


def _errors(name: str, rounds: int) -> list[Row]:
    scene, rows = standard(name), []
    _, want, want_gradients = runs.once(runs.renderer("reference"), copy.deepcopy(scene).double(), 0.0)
    for backend in runs.backends():
        for cutoff in CUTOFFS:
            with threads(1):
                timings = runs.timed(backend, scene, cutoff, rounds)
                _, image, gradients = runs.once(runs.renderer(backend), scene, cutoff)
            error = (image - want).abs()
            pairs = list(zip(gradients, want_gradients, strict=True))
            row = partial(Row, "error", _case(name, cutoff), backend, 1)
            rows += [
                row("sum", 1e3 * statistics.median(t.sum for t in timings), "ms"),
                row("image max", float(error.max()), "1"),
                row("image rms", _rms(error), "1"),
                row("gradient max", max(_largest(g - w) / _largest(w) for g, w in pairs), "relative to the largest"),
                row("gradient rms", max(_rms(g - w) / _rms(w) for g, w in pairs), "relative to the rms"),
            ]
    return rows


def _largest(values: Tensor) -> float:
    return float(values.abs().max())


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def _growth(rounds: int, quick: bool) -> list[Row]:
    counts = (100, 400) if quick else (100, 400, 1_600, 6_400, 25_600)
    heights = (60, 120) if quick else (120, 240, 480, 960, 1_920)
    sizes = [(h, h * 16 // 9) for h in heights]
    grown = {
        "Gaussians": {f"N = {n}": workload(480, 854, n, spread=8.0) for n in counts},
        "pixels": {f"{h} x {w}": workload(h, w, max(1, h * h // 300)) for h, w in sizes},
    }
    rows = []
    for axis, scenes in grown.items():
        pairs = [runs.evaluated_pairs(scene, DEFAULT_CUTOFF) for scene in scenes.values()]
        for backend in runs.backends():
            seconds = []
            for name, scene, count in zip(scenes, scenes.values(), pairs, strict=True):
                with threads(1):
                    seconds.append(statistics.median(t.sum for t in runs.timed(backend, scene, DEFAULT_CUTOFF, rounds)))
                row = partial(Row, "growth", f"{axis}: {name}", backend, 1)
                rows += [row("pairs", count / 1e6, "M"), row("sum", 1e3 * seconds[-1], "ms")]
            slope = float(np.polyfit(np.log(pairs), np.log(seconds), 1)[0])
            rows.append(Row("growth", axis, backend, 1, EXPONENT, slope, "1"))
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


def _plot_error(rows: Readings, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    cutoffs = Readings(row._replace(case=row.case.split()[-1]) for row in rows)
    for axis, quantity in zip(axes, ("image max", "gradient max"), strict=True):
        for name in rows.names("backend"):
            line = cutoffs.select(backend=name)
            line.plot(axis, "case", "sum", quantity, annotate=True, marker="o", label=name)
        axis.set(xlabel="milliseconds, forward and backward", ylabel=f"{quantity} error")
        axis.legend()
    axes[0].set_title("points: cutoff")
    save_figure(plot, path)


def _plot_growth(rows: Readings, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, kind in zip(axes, ("Gaussians", "pixels"), strict=True):
        for name in rows.names("backend"):
            line = Readings(row for row in rows.select(backend=name) if row.case.startswith(f"{kind}:"))
            label = f"{name}, exponent {rows.value(case=kind, backend=name, quantity=EXPONENT):.2f}"
            line.plot(axis, "case", "pairs", "sum", marker="o", label=label)
        axis.set(xlabel="million evaluated pairs", ylabel="milliseconds")
        axis.set_title(f"growing {'N' if kind == 'Gaussians' else kind}")
        axis.legend()
    save_figure(plot, path)


def _plot_stiffness(rows: Readings, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, quantity in zip(axes, ("image", "gradient"), strict=True):
        for color, name in zip(COLORS, rows.names("backend"), strict=False):
            lines: dict[float, list[tuple[float, float]]] = {}
            for row in rows.select(backend=name, quantity=quantity):
                _, sigma, _, anisotropy = row.case.split()
                lines.setdefault(float(sigma), []).append((float(anisotropy), max(row.value, 1e-9)))
            for sigma, points in lines.items():
                label = name if sigma == max(lines) else None
                axis.plot(*zip(*points, strict=True), SIGMAS[sigma], color=color, marker=".", label=label)
        axis.set(xlabel="anisotropy", ylabel=f"{quantity} error, max", xscale="log", yscale="log")
        axis.legend()
    axes[0].set_title("thin sigma: 5 px solid, 0.5 px dashed, 0.05 px dotted")
    save_figure(plot, path)
