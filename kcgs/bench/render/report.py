"""From rows to a report with tables and figures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from kcgs._atomic import atomic_path
from kcgs.bench.machine import describe
from kcgs.bench.plots import COLORS, figure, save_figure

_SPEED_TEXT = """Milliseconds, medians; through `region_splat` and autograd, validation included. Coverage 12
Gaussians a pixel (3 sigma), 6 regions. W3 is 200x300 with 20 Gaussians, W1 480x854 with 1,250, W2 480x854 with 7,500,
W4 2160x3840 with 50,000. `limit` is the same arithmetic for the same pairs with nothing read and nothing written. The
plain-torch peers run on one thread; where they are missing they need too much memory."""
_LIMIT_TEXT = """Kernel and limit are timed in turns; shares and gains are medians of the ratios of neighbouring runs.
The limit's own gain tells what a second thread is worth on this machine. Images a second are through
`RegionSplatRenderer`, without gradients."""
_ERROR_TEXT = """One thread. Image error against the float64 reference at cutoff 0, colours in [0, 1]; gradient error
relative to the largest gradient (max) or the rms gradient (rms), the worst of means, cholesky and colors."""
_GROWTH_TEXT = """Forward and backward against evaluated pairs, one thread. An exponent of 1 is a flat cost a pair; it
is below 1 where the fixed costs of a picture (filling and reading its pixels) weigh less as pairs grow."""
_STIFF_TEXT = """37 needles of one shape, turned from 0 to 180 degrees, drawn in float32 at cutoff 0 against float64.
Image error relative to a colour of 1; gradient error relative to the largest of its component. The parameters are the
same float32 numbers on both sides: what is measured is the arithmetic."""


class Row(NamedTuple):
    """One measured number."""

    section: str
    case: str
    backend: str
    threads: int
    quantity: str
    value: float
    unit: str


class Table:
    """Rows by what they measure."""

    def __init__(self, rows: Iterable[Row]) -> None:
        self.rows = list(rows)

    def value(self, section: str, case: str, backend: str, quantity: str, threads: int = 1) -> float | None:
        """One number, or None where it was not measured."""
        for r in self.rows:
            if (r.section, r.case, r.backend, r.quantity, r.threads) == (section, case, backend, quantity, threads):
                return r.value
        return None

    def names(self, section: str, field: str) -> list[str]:
        """Cases or backends of a section, in order."""
        return list(dict.fromkeys(getattr(r, field) for r in self.rows if r.section == section))


def write(output: Path, rows: list[Row], quick: bool) -> None:
    """Write report.md and its figures into the folder."""
    table = Table(rows)
    _plot_error(table, output / "error-against-time.png")
    _plot_growth(table, output / "growth.png")
    _plot_stiffness(table, output / "stiffness.png")
    parts = ["# Rendering: speed, error, stability", f"Made by `kcgs bench render{' --quick' if quick else ''}`."]
    parts += ["\n".join(f"- {line}" for line in describe())]
    parts += ["## Speed", _SPEED_TEXT, _speed(table)]
    parts += ["## Against the limit of the processor", _LIMIT_TEXT, _against_limit(table)]
    parts += ["## Overhead of the module", _overhead(table)]
    parts += ["## Peak memory", "MiB added by one drawing and its gradients, in a process of its own.", _memory(table)]
    parts += ["## Error against run time", _ERROR_TEXT, "![](error-against-time.png)", _errors(table)]
    parts += ["## Growth", _GROWTH_TEXT, "![](growth.png)", _exponents(table)]
    parts += ["## Stiffness", _STIFF_TEXT, "![](stiffness.png)", _stiffness(table)]
    with atomic_path(output / "report.md") as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _markdown(header: list[str], lines: list[list[Any]]) -> str:
    def cell(value: Any) -> str:
        if value is None:
            return ""
        return f"{value:.3g}" if isinstance(value, float) and abs(value) < 100 else str(
            round(value) if isinstance(value, float) else value
        )  # fmt: skip

    rows = [header, ["---"] * len(header), *([cell(v) for v in line] for line in lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _speed(table: Table) -> str:
    header = ["workload", "backend", "forward", "backward", "sum", "sum, 2 threads", "ratio to cpu"]
    lines: list[list[Any]] = []
    for case in table.names("speed", "case"):
        best = table.value("speed", case, "cpu", "sum")
        for backend in table.names("speed", "backend"):
            one = [table.value("speed", case, backend, quantity) for quantity in ("forward", "backward", "sum")]
            if one[2] is not None and best:
                lines.append([case, backend, *one, table.value("speed", case, backend, "sum", 2), one[2] / best])
    return _markdown(header, lines)


def _against_limit(table: Table) -> str:
    lines: list[list[Any]] = []
    for case in table.names("limit", "case"):
        count = table.value("limit", case, "limit", "pairs") or 0.0
        rates = [count / (table.value("speed", case, "cpu", q) or math.nan) for q in ("forward", "backward")]
        share = table.value("limit", case, "cpu", "share") or math.nan
        gains = [table.value("limit", case, name, "gain", 2) for name in ("cpu", "limit")]
        lines.append(
            [case, count, *rates, f"{100 * share:.0f} %", *gains, table.value("limit", case, "cpu", "images", 2)]
        )
    header = ["workload", "evaluated pairs (M)", "forward Gpairs/s", "backward Gpairs/s", "share of the limit"]
    header += ["gain of 2 threads", "the limit's gain", "images/s, forward only, 2 threads"]
    return _markdown(header, lines)


def _overhead(table: Table) -> str:
    lines: list[list[Any]] = []
    for case in table.names("overhead", "case"):
        alone, whole = (table.value("overhead", case, "cpu", q) for q in ("kernel alone", "module and autograd"))
        if alone and whole:
            lines.append([case, alone, whole, f"{100 * (whole / alone - 1):.0f} %"])
    return _markdown(["workload", "kernel alone (ms)", "through RegionSplatRenderer and autograd (ms)", "more"], lines)


def _memory(table: Table) -> str:
    cases = table.names("memory", "case")
    lines = [[b, *(table.value("memory", c, b, "peak") for c in cases)] for b in table.names("memory", "backend")]
    return _markdown(["backend", *cases], lines)


def _errors(table: Table) -> str:
    quantities = ["sum", "image max", "image rms", "gradient max", "gradient rms"]
    lines = [
        [b, c, *(f"{table.value('error', c, b, q):.2g}" for q in quantities)]
        for b in table.names("error", "backend")
        for c in table.names("error", "case")
    ]
    return _markdown(["backend", "case", "ms", *quantities[1:]], lines)


def _exponents(table: Table) -> str:
    quantity = "exponent of time in pairs"
    lines = [
        [b, *(table.value("growth", axis, b, quantity) for axis in ("Gaussians", "pixels"))]
        for b in table.names("growth", "backend")
    ]
    return _markdown(["backend", "exponent, growing N", "exponent, growing pixels"], lines)


def _stiffness(table: Table) -> str:
    found = table.names("stiffness", "backend")
    lines = [
        [c, *(f"{table.value('stiffness', c, b, q):.1e}" for b in found for q in ("image", "gradient"))]
        for c in table.names("stiffness", "case")
    ]
    return _markdown(["case", *(f"{b} {q}" for b in found for q in ("image", "gradient"))], lines)


def _plot_error(table: Table, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, quantity in zip(axes, ("image max", "gradient max"), strict=True):
        for backend in table.names("error", "backend"):
            cases = table.names("error", "case")
            points = [
                (table.value("error", c, backend, "sum"), table.value("error", c, backend, quantity)) for c in cases
            ]
            axis.plot([p[0] for p in points], [p[1] for p in points], marker="o", label=backend)
            for case, (x, y) in zip(cases, points, strict=True):
                label = case.split()[-1]
                axis.annotate(label, (x, y), textcoords="offset points", xytext=(4, 4), fontsize=7)
        axis.set(xlabel="milliseconds, forward and backward", ylabel=f"{quantity} error", xscale="log", yscale="log")
        axis.legend()
    axes[0].set_title("points: cutoff")
    save_figure(plot, path)


def _plot_growth(table: Table, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, name in zip(axes, ("Gaussians", "pixels"), strict=True):
        cases = [c for c in table.names("growth", "case") if c.startswith(f"{name}:")]
        for backend in table.names("growth", "backend"):
            x = [table.value("growth", c, backend, "pairs") for c in cases]
            y = [table.value("growth", c, backend, "sum") for c in cases]
            slope = table.value("growth", name, backend, "exponent of time in pairs")
            axis.plot(x, y, marker="o", label=f"{backend}, exponent {slope:.2f}")
        axis.set(xlabel="million evaluated pairs", ylabel="milliseconds", xscale="log", yscale="log")
        axis.set_title(f"growing {'N' if name == 'Gaussians' else name}")
        axis.legend()
    save_figure(plot, path)


def _plot_stiffness(table: Table, path: Path) -> None:
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    styles = {"0.05": ":", "0.5": "--", "5": "-"}
    for axis, quantity in zip(axes, ("image", "gradient"), strict=True):
        for index, backend in enumerate(table.names("stiffness", "backend")):
            for sigma, style in styles.items():
                cases = [c for c in table.names("stiffness", "case") if c.split()[1] == sigma]
                x = [float(c.split()[3]) for c in cases]
                y = [max(table.value("stiffness", c, backend, quantity) or 0.0, 1e-9) for c in cases]
                label = backend if sigma == "5" else None
                axis.plot(x, y, style, color=COLORS[index], marker=".", label=label)
        axis.set(xlabel="anisotropy", ylabel=f"{quantity} error, max", xscale="log", yscale="log")
        axis.legend()
    axes[0].set_title("thin sigma: 5 px solid, 0.5 px dashed, 0.05 px dotted")
    save_figure(plot, path)
