"""Tables, and numbers as reports write them; in Markdown, what is not a number is an empty cell."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from kcgs._atomic import atomic_path


def markdown(header: list[str], lines: Iterable[list[str]]) -> str:
    """Lay out a table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [header, ["---"] * len(header), *lines])


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a table, floats with six digits; the file appears whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows)


def db(value: float) -> str:
    """Write decibels."""
    return "" if math.isnan(value) else f"{value:.2f}"


def signed(value: float) -> str:
    """Write a difference of decibels."""
    return "" if math.isnan(value) else f"{round(value, 2) + 0.0:+.2f}"  # no -0.00


def seconds(value: float) -> str:
    """Write a wall time."""
    return "" if math.isnan(value) else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def count(value: float) -> str:
    """Write a whole number."""
    return "" if math.isnan(value) else f"{value:,.0f}"
