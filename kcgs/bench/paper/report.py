"""What the four reports have in common."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from kcgs._atomic import atomic_path
from kcgs.bench.cells import write_csv
from kcgs.bench.machine import describe

from .methods import FULL_ITERATIONS
from .options import Options
from .trials import Row, Trial

_NOT_WRITTEN = ("scene", "history")
_QUICK_TEXT = "The short form, small pictures and few iterations: the numbers only show that all of it runs."
METRICS_TEXT = """PSNR and MS-SSIM are over the whole picture, EF-PSNR and edge SSIM within 5 pixels of the contours of
the given map, for every method alike; decibels, of values clipped to [0, 1]. `paper` is the paper's method, `gaussian-
image` its baseline without clamp and `gaussian-image-clamp` with it, `best` ours, and `best-baseline` ours with the
regions off, the baseline improved as much. All run on the same kernel. Differences are paired by picture, above zero
where the first is better; intervals are 95 %, by bootstrap over pictures, widened for their small number, where
there are five or more. Seconds are wall time of a fit, which other work on the machine slows; core s is its processor
time. *N left* are the Gaussians that the end of a fit leaves."""


def head(title: str, name: str, options: Options) -> list[str]:
    """Begin a report: title, command, machine."""
    parts = [f"# {title}", f"Made by `{options.command(name)}`."]
    parts.append("\n".join(f"- {line}" for line in [*describe(), f"Fits: {options.place}"]))
    return [*parts, _QUICK_TEXT] if options.quick else parts


def what_was_run(rows: Sequence[Row], wanted: Sequence[Trial], options: Options) -> str:
    """State pictures, iterations, seconds, and what is missing."""
    there = {(row.picture, row.n, row.method, row.seed) for row in rows}
    lacking = [t for t in wanted if (t.picture, t.n, t.method.name, t.seed) not in there]
    lines = [f"- Pictures: {', '.join(dict.fromkeys(row.picture for row in rows)) or 'none'}."]
    published = sorted({t.config().iterations for t in wanted if t.method.is_published})
    own = sorted({t.config().iterations for t in wanted if not t.method.is_published})
    if published == [FULL_ITERATIONS]:
        lines.append(f"- Published recipes: their own {FULL_ITERATIONS:,} iterations.")
    elif published:
        lines.append(
            f"- Published recipes: {' and '.join(f'{i:,}' for i in published)} iterations, not {FULL_ITERATIONS:,}, "
            "with their schedule shortened and larger steps, by the recipes' own rule: not the published figures."
        )
    if own:
        lines.append(f"- Ours: {' and '.join(f'{i:,}' for i in own)} iterations.")
    known = sum(row.seconds for row in rows if not math.isnan(row.seconds))
    lines.append(f"- {len(rows)} fits are there, of {known:,.0f} s in all.")
    if options.runs is not None:
        lines.append("- Fits are shared with the other benches, which may have made them.")
    if lacking:
        budget = (
            "" if options.budget_seconds is None else f" the budget of {options.budget_seconds:,.0f} s was over, or"
        )
        lines.append(
            f"- Missing, for{budget} the run was stopped: {len(lacking)} of {len(wanted)} fits: {_missing(lacking)}."
        )
    return "\n".join(lines)


def write(output: Path, rows: Sequence[Row], parts: Sequence[str]) -> None:
    """Write report.md and results.csv."""
    with atomic_path(output / "report.md") as temporary:
        temporary.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    names = [field.name for field in dataclasses.fields(Row) if field.name not in _NOT_WRITTEN]
    names.append("bits_per_pixel")
    write_csv(output / "results.csv", names, ([getattr(row, name) for name in names] for row in rows))


def read_rows(path: Path) -> list[Row]:
    """Read what `write` wrote: all but scenes and histories."""
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    read: dict[Any, Callable[[str], Any]] = {"str": str, "int": int, "float": float}
    kinds = {field.name: read[field.type] for field in dataclasses.fields(Row) if field.name not in _NOT_WRITTEN}
    return [Row(scene="", **{name: kind(line[name]) for name, kind in kinds.items()}) for line in lines]


def _missing(lacking: Sequence[Trial]) -> str:
    """Group what is missing by N."""
    parts = []
    for n in sorted({t.n for t in lacking}):
        here = [t for t in lacking if t.n == n]
        pictures = list(dict.fromkeys(t.picture for t in here))
        shown = ", ".join(pictures[:4]) + (f" and {len(pictures) - 4} more pictures" if len(pictures) > 4 else "")
        parts.append(f"N = {n:,}: {len(here)} of {shown}")
    return "; ".join(parts)
