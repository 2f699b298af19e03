"""Measured numbers, one in each row, and how a report finds them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

from .tables import markdown, number


class Readings(list[Any]):
    """Rows with a field `value`, a number, and fields that say of what: a `quantity`, its `unit` and others."""

    def __init__(self, rows: Iterable[Any]) -> None:
        super().__init__(rows)

    def select(self, **fields: object) -> Readings:
        """Return the rows with these fields."""
        return Readings(row for row in self if all(getattr(row, name) == value for name, value in fields.items()))

    def value(self, **fields: object) -> float:
        """Return the number of the row with these fields, NaN where it was not measured."""
        found = self.select(**fields)
        return found[0].value if found else math.nan

    def names(self, field: str) -> list[Any]:
        """Return what a field holds, each once, in order."""
        return list(dict.fromkeys(getattr(row, field) for row in self))

    def table(self, *index: str, across: Sequence[str] = ("quantity",)) -> str:
        """Lay out all numbers as a Markdown table.

        Args:
            index: fields of which each combination that occurs has a line.
            across: fields of which each combination has a column; one thread is not said.
        """
        cells, titles = {}, {}
        for row in self:
            line, column = (tuple(getattr(row, field) for field in fields) for fields in (index, across))
            cells[line, column] = number(row.value)
            titles[column] = _title(row, across)
        lines = {line for line, _ in cells}
        ordered = [line for line in product(*map(self.names, index)) if line in lines]
        body = [[*map(str, line), *(cells.get((line, column), "") for column in titles)] for line in ordered]
        return markdown([*index, *titles.values()], body)

    def plot(self, axis: Any, along: str, x: str, y: str, **style: Any) -> None:
        """Plot a line through the quantities `x` and `y` of each name that the field `along` has, on log axes."""
        names = self.names(along)
        points = [[self.value(**{along: name, "quantity": quantity}) for quantity in (x, y)] for name in names]
        axis.plot(*zip(*points, strict=True), **style)
        axis.set(xscale="log", yscale="log")
        for name, point in zip(names, points, strict=True):
            axis.annotate(name, point, textcoords="offset points", xytext=(4, 4), fontsize=7)


def _title(row: Any, across: Sequence[str]) -> str:
    parts = [str(getattr(row, field)) for field in across if field != "threads"]
    parts += [row.unit] if "quantity" in across and row.unit != "1" else []
    parts += [f"{row.threads} threads"] if "threads" in across and row.threads > 1 else []
    return ", ".join(parts)
