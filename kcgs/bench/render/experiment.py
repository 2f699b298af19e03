"""The measurements, in order, and what becomes of them."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcgs.bench.cells import write_csv

from .limit import evaluated_pairs, seconds_for
from .peers import MOST_PAIRS, PEERS, pairs
from .report import Row, write
from .stiffness import sweep
from .timing import (
    Timing,
    drawer,
    images_per_second,
    medians,
    once,
    overhead,
    peak_memory,
    probe_of,
    threads,
)
from .workloads import STANDARD, Workload, standard, workload

CUTOFFS = (1 / 255, 1e-3, 1e-4, 1e-6, 0.0)
DEFAULT_CUTOFF = 1e-4
SPEED_CUTOFFS = (1 / 255, DEFAULT_CUTOFF)
# the dense reference is timed where it takes seconds
DENSE = ("W3",)


def run(output: Path, *, data: Path | None = None, quick: bool = False) -> None:
    """Measure speed, memory, error against run time, growth and stiffness; write results.csv, report.md, figures."""
    from rich.console import Console
    from rich.progress import Progress

    repeats = 1 if quick else 5
    standards = ("W3",) if quick else tuple(STANDARD)
    steps: list[tuple[str, Callable[[], list[Row]]]] = [
        # first, since peers leave a gigabyte of memory in pieces behind them
        *((f"kernel and limit {name}", partial(_beside_limit, name, 3 * repeats)) for name in standards),
        *((f"speed {name}", partial(_speed, name, repeats)) for name in standards),
        ("overhead", partial(_overhead, standards[: 1 if quick else 2], repeats)),
        ("memory", lambda: _memory(standards[:1] if quick else ("W1", "W2", "W4"))),
        ("error against run time", lambda: _error_and_time("W3" if quick else "W1", repeats)),
        ("growth", lambda: _growth(repeats, quick)),
        ("stiffness", _stiffness),
    ]
    rows: list[Row] = []
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=len(steps))
        for name, step in steps:
            progress.update(task, description=name)
            rows += step()
            progress.advance(task)
    write_csv(output / "results.csv", Row._fields, rows)
    write(output, rows, quick)
    Console().print(f"{output}/report.md")


def backends() -> list[str]:
    """Backends that run here."""
    return ["cpu", "tiled", *(["cuda"] if torch.cuda.is_available() else [])]


def _speed(name: str, repeats: int) -> list[Row]:
    scene = standard(name)
    rows = []
    for cutoff in SPEED_CUTOFFS:
        names = [*(b for b in backends() if b != "cpu"), *(["reference"] if name in DENSE else [])]
        names += [peer for peer in PEERS if pairs(peer, scene, cutoff) <= MOST_PAIRS]
        for backend in names:
            for count in (1,) if backend in PEERS else (1, 2):
                with threads(count):
                    timing = medians(backend, scene, cutoff, repeats)
                rows += _timing_rows(_case(name, cutoff), backend, count, [timing])
    return rows


def _beside_limit(name: str, repeats: int) -> list[Row]:
    scene = standard(name)
    return [row for cutoff in SPEED_CUTOFFS for row in _in_turns(scene, _case(name, cutoff), cutoff, repeats)]


def _in_turns(scene: Workload, case: str, cutoff: float, repeats: int) -> list[Row]:
    """Time the CPU kernel and the limit in turns, on one thread and on two: a shared machine's speed drifts."""
    count = evaluated_pairs(scene, cutoff)
    draw, probe = drawer("cpu"), probe_of(scene)
    found: dict[tuple[str, int], list[Timing]] = {(name, n): [] for name in ("limit", "cpu") for n in (1, 2)}
    for _ in range(repeats + 1):
        for n in (1, 2):
            limits = (seconds_for(count, backward=kind, threads=n) for kind in (False, True))
            found["limit", n].append(Timing(*limits))
            with threads(n):
                found["cpu", n].append(once(draw, scene, cutoff, probe)[0])
    found = {key: timings[1:] for key, timings in found.items()}
    rows = [Row("limit", case, "limit", 1, "pairs", count / 1e6, "M")]
    for (name, n), timings in found.items():
        rows += _timing_rows(case, name, n, timings)
    in_turns = zip(found["limit", 1], found["cpu", 1], strict=True)
    rows.append(Row("limit", case, "cpu", 1, "share", statistics.median(a.sum / b.sum for a, b in in_turns), "1"))
    for name in ("limit", "cpu"):
        in_turns = zip(found[name, 1], found[name, 2], strict=True)
        gain = statistics.median(one.sum / two.sum for one, two in in_turns)
        rows.append(Row("limit", case, name, 2, "gain", gain, "1"))
    with threads(2):
        rows.append(Row("limit", case, "cpu", 2, "images", images_per_second(scene, cutoff, repeats), "1/s"))
    return rows


def _case(name: str, cutoff: float) -> str:
    return f"{name} cutoff {cutoff:.2g}"


def _timing_rows(case: str, backend: str, count: int, timings: list[Timing]) -> list[Row]:
    return [
        Row(
            "speed",
            case,
            backend,
            count,
            quantity,
            1e3 * statistics.median(getattr(t, quantity) for t in timings),
            "ms",
        )
        for quantity in ("forward", "backward", "sum")
    ]


def _overhead(names: tuple[str, ...], repeats: int) -> list[Row]:
    rows = []
    for name in names:
        with threads(1):
            alone, whole = overhead(standard(name), DEFAULT_CUTOFF, 4 * repeats)
        for quantity, value in (("kernel alone", alone), ("module and autograd", whole)):
            rows.append(Row("overhead", name, "cpu", 1, quantity, 1e3 * value, "ms"))
    return rows


def _memory(names: tuple[str, ...]) -> list[Row]:
    rows = []
    for name in names:
        scene = standard(name)
        for backend in ("cpu", "tiled", *PEERS):
            if backend in PEERS and pairs(backend, scene, DEFAULT_CUTOFF) > MOST_PAIRS:
                continue
            peak = peak_memory(backend, name, DEFAULT_CUTOFF)
            rows.append(Row("memory", name, backend, 1, "peak", peak, "MiB"))
    return rows


def _error_and_time(name: str, repeats: int) -> list[Row]:
    scene = standard(name)
    exact = scene.double()
    _, want, want_gradients = once(drawer("reference"), exact, 0.0, probe_of(exact))
    rows = []
    for backend in backends():
        for cutoff in CUTOFFS:
            with threads(1):
                timing = medians(backend, scene, cutoff, repeats)
                _, image, gradients = once(drawer(backend), scene, cutoff, probe_of(scene))
            case = f"{name} cutoff {cutoff:.2g}"
            error = (image - want).abs()
            rows.append(Row("error", case, backend, 1, "sum", 1e3 * timing.sum, "ms"))
            rows.append(Row("error", case, backend, 1, "image max", float(error.max()), "1"))
            rows.append(Row("error", case, backend, 1, "image rms", float(error.square().mean().sqrt()), "1"))
            largest, mean = _gradient_error(gradients, want_gradients)
            rows.append(Row("error", case, backend, 1, "gradient max", largest, "relative to the largest"))
            rows.append(Row("error", case, backend, 1, "gradient rms", mean, "relative to the rms"))
    return rows


def _gradient_error(got: list[Tensor], want: list[Tensor]) -> tuple[float, float]:
    largest = [float((g - w).abs().max() / w.abs().max()) for g, w in zip(got, want, strict=True)]
    rms = [float((g - w).square().mean().sqrt() / w.square().mean().sqrt()) for g, w in zip(got, want, strict=True)]
    return max(largest), max(rms)


def _growth(repeats: int, quick: bool) -> list[Row]:
    counts = (100, 400) if quick else (100, 400, 1_600, 6_400, 25_600)
    heights = (60, 120) if quick else (120, 240, 480, 960, 1_920)
    by_count: list[Workload] = [workload(f"N = {n}", 480, 854, n, spread=8.0) for n in counts]
    by_pixels = [workload(f"{h} x {h * 16 // 9}", h, h * 16 // 9, max(1, h * h // 300)) for h in heights]
    rows = []
    for axis, scenes in (("Gaussians", by_count), ("pixels", by_pixels)):
        for backend in backends():
            evaluated, seconds = [], []
            for scene in scenes:
                with threads(1):
                    timing = medians(backend, scene, DEFAULT_CUTOFF, repeats)
                evaluated.append(evaluated_pairs(scene, DEFAULT_CUTOFF))
                seconds.append(timing.sum)
                case = f"{axis}: {scene.name}"
                rows.append(Row("growth", case, backend, 1, "pairs", evaluated[-1] / 1e6, "M"))
                rows.append(Row("growth", case, backend, 1, "sum", 1e3 * seconds[-1], "ms"))
            slope = float(np.polyfit(np.log(evaluated), np.log(seconds), 1)[0])
            rows.append(Row("growth", axis, backend, 1, "exponent of time in pairs", slope, "1"))
    return rows


def _stiffness() -> list[Row]:
    rows = []
    for r in sweep([*backends(), "reference"]):
        case = f"sigma {r.sigma:g} anisotropy {r.anisotropy:g}"
        rows.append(Row("stiffness", case, r.backend, 1, "image", r.image, "1"))
        rows.append(Row("stiffness", case, r.backend, 1, "gradient", r.gradient, "relative to the largest"))
    return rows
