"""The report of `kcgs bench render`."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from kcgs.plots import COLORS, figure, save_figure

from .core.readings import Column, Readings
from .core.report import Made
from .core.rows import read_rows

# of a needle's thin axis, and how the figure shows it
SIGMAS = {0.05: ":", 0.5: "--", 5.0: "-"}
EXPONENT = "exponent of time in pairs"
_EXPONENTS = {"exponent, growing N": {"case": "Gaussians"}, "exponent, growing pixels": {"case": "pixels"}}

_SPEED_TEXT = """Milliseconds, medians; through `region_splat` and autograd, validation included. Coverage is 12
Gaussians per pixel (3 sigma), with 6 regions. W3 is 200x300 with 20 Gaussians, W1 480x854 with 1,250, W2 480x854 with
7,500, W4 2160x3840 with 50,000. `limit` is the same arithmetic for the same pairs with nothing read and nothing
written. The plain-torch peers run on one thread; where they are missing they need too much memory."""
_LIMIT_TEXT = """Kernel and limit are timed in turns; shares and gains are medians of the ratios of neighbouring runs.
The limit's own gain is what a second thread gives on this machine. Images per second are through
`RegionSplatRenderer`, without gradients."""
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
    rows = Readings(read_rows(folder / "results.csv", Row))
    errors, growth, stiffness = (rows.select(section=name) for name in ("error", "growth", "stiffness"))
    _plot_error(errors, folder / "error-against-time.png")
    _plot_growth(growth, folder / "growth.png")
    _plot_stiffness(stiffness, folder / "stiffness.png")
    speed, limit = rows.select(section="speed"), rows.select(section="limit")
    parts = ["# Rendering: speed, error, stability", "## Speed", _SPEED_TEXT, _speed_table(speed)]
    parts += ["## Against the limit of the processor", _LIMIT_TEXT, _limit_table(limit, speed)]
    parts += ["## Overhead of the module", _overhead_table(rows.select(section="overhead"))]
    parts += ["## Peak memory", _MEMORY_TEXT, _memory_table(rows.select(section="memory"))]
    parts += ["## Error against run time", _ERROR_TEXT, "![](error-against-time.png)", _error_table(errors)]
    exponents = growth.select(quantity=EXPONENT).table(["backend"], _EXPONENTS)
    parts += ["## Growth", _GROWTH_TEXT, "![](growth.png)", exponents]
    return [*parts, "## Stiffness", _STIFFNESS_TEXT, "![](stiffness.png)", _stiffness_table(stiffness)]


def _speed_table(rows: Readings) -> str:
    kernel = rows.select(backend="cpu", quantity="sum", threads=1)

    def ratio(line: Readings) -> float:
        return line.value(quantity="sum", threads=1) / kernel.value(case=line[0].case)

    columns: dict[str, Column] = {q: {"quantity": q, "threads": 1} for q in ("forward", "backward", "sum")}
    columns |= {"sum, 2 threads": {"quantity": "sum", "threads": 2}, "ratio to cpu": ratio}
    return rows.table(["case", "backend"], columns)


def _limit_table(rows: Readings, speed: Readings) -> str:
    def rate(quantity: str) -> Callable[[Readings], float]:
        kernel = speed.select(backend="cpu", threads=1, quantity=quantity)
        return lambda line: line.value(quantity="pairs") / kernel.value(case=line[0].case)

    return rows.table(
        ["case"],
        {
            "evaluated pairs (M)": {"quantity": "pairs"},
            "forward Gpairs/s": rate("forward"),
            "backward Gpairs/s": rate("backward"),
            "share of the limit": lambda line: f"{100 * line.value(quantity='share'):.0f} %",
            "gain of 2 threads": {"quantity": "gain", "backend": "cpu"},
            "the limit's gain": {"quantity": "gain", "backend": "limit"},
            "images/s, forward only, 2 threads": {"quantity": "images"},
        },
    )


def _overhead_table(rows: Readings) -> str:
    alone, whole = {"quantity": "kernel alone"}, {"quantity": "module and autograd"}

    def more(line: Readings) -> str:
        return f"{100 * (line.value(**whole) / line.value(**alone) - 1):.0f} %"

    return rows.table(
        ["case"],
        {"kernel alone (ms)": alone, "through RegionSplatRenderer and autograd (ms)": whole, "more": more},
    )


def _memory_table(rows: Readings) -> str:
    return rows.table(["backend"], {case: {"case": case} for case in rows.names("case")})


def _error_table(rows: Readings) -> str:
    names = {"ms" if quantity == "sum" else quantity: quantity for quantity in rows.names("quantity")}
    return rows.table(["backend", "case"], {name: {"quantity": quantity} for name, quantity in names.items()})


def _stiffness_table(rows: Readings) -> str:
    pairs = product(rows.names("backend"), rows.names("quantity"))
    return rows.table(
        ["case"], {f"{name} {quantity}": {"backend": name, "quantity": quantity} for name, quantity in pairs}
    )


def _plot_error(rows: Readings, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, quantity in zip(axes, ("image max", "gradient max"), strict=True):
        for backend in rows.names("backend"):
            points = _plot_line(axis, rows.select(backend=backend), "sum", quantity, backend)
            for case, point in zip(rows.names("case"), points, strict=True):
                axis.annotate(case.split()[-1], point, textcoords="offset points", xytext=(4, 4), fontsize=7)
        axis.set(xlabel="milliseconds, forward and backward", ylabel=f"{quantity} error")
    axes[0].set_title("points: cutoff")
    save_figure(plot, path)


def _plot_growth(rows: Readings, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, name in zip(axes, ("Gaussians", "pixels"), strict=True):
        for backend in rows.names("backend"):
            line = Readings(row for row in rows.select(backend=backend) if row.case.startswith(f"{name}:"))
            slope = rows.value(case=name, backend=backend, quantity=EXPONENT)
            _plot_line(axis, line, "pairs", "sum", f"{backend}, exponent {slope:.2f}")
        axis.set(xlabel="million evaluated pairs", ylabel="milliseconds")
        axis.set_title(f"growing {'N' if name == 'Gaussians' else name}")
    save_figure(plot, path)


def _plot_line(axis: Any, rows: Readings, x: str, y: str, label: str) -> list[tuple[float, float]]:
    points = [(rows.value(case=case, quantity=x), rows.value(case=case, quantity=y)) for case in rows.names("case")]
    axis.plot(*zip(*points, strict=True), marker="o", label=label)
    axis.set(xscale="log", yscale="log")
    axis.legend()
    return points


def _plot_stiffness(rows: Readings, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, quantity in zip(axes, ("image", "gradient"), strict=True):
        for color, backend in zip(COLORS, rows.names("backend"), strict=False):
            for sigma, style in SIGMAS.items():
                line = rows.select(backend=backend, quantity=quantity)
                points = [
                    (float(r.case.split()[3]), max(r.value, 1e-9)) for r in line if float(r.case.split()[1]) == sigma
                ]
                label = backend if sigma == 5 else None
                axis.plot(*zip(*points, strict=True), style, color=color, marker=".", label=label)
        axis.set(xlabel="anisotropy", ylabel=f"{quantity} error, max", xscale="log", yscale="log")
        axis.legend()
    axes[0].set_title("thin sigma: 5 px solid, 0.5 px dashed, 0.05 px dotted")
    save_figure(plot, path)
