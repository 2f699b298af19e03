"""Tables in Markdown, and numbers as reports write them: what is not a number is an empty cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

Item = TypeVar("Item")


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Lay out a table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [header, ["---"] * len(header), *lines])


def table(columns: Mapping[str, Callable[[Item], str]], items: Iterable[Item]) -> str:
    """Lay out a table with a line for each item, from what writes each column."""
    return markdown(list(columns), ([write(item) for write in columns.values()] for item in items))


def db(value: float) -> str:
    """Write decibels."""
    return "" if math.isnan(value) else f"{value:.2f}"


def signed(value: float) -> str:
    """Write a difference of decibels."""
    return "" if math.isnan(value) else f"{round(value, 2) + 0.0:+.2f}"  # no -0.00


def similarity(value: float) -> str:
    """Write an SSIM."""
    return "" if math.isnan(value) else f"{value:.4f}"


def seconds(value: float) -> str:
    """Write a wall time."""
    return "" if math.isnan(value) else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def number(value: float) -> str:
    """Write a measured number with three digits, whole from a hundred on."""
    if math.isnan(value):
        return ""
    if value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1e}" if abs(value) < 0.01 else f"{value:.3g}"


def count(value: float) -> str:
    """Write a whole number."""
    return "" if math.isnan(value) else f"{value:,.0f}"
