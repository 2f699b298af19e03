"""Measured numbers, one in each row, and how a report finds them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import Any

from .tables import markdown, number


class Readings(list[Any]):
    """Rows with a field `value`, a number, and fields that say what was measured.

    Example:
        >>> from typing import NamedTuple
        >>> class Row(NamedTuple):
        ...     case: str
        ...     quantity: str
        ...     value: float
        >>> rows = Readings([Row("a", "ms", 1.0), Row("b", "ms", 2.0), Row("b", "MB", 3.5)])
        >>> rows.value(case="b", quantity="ms"), rows.value(case="c"), rows.names("case")
        (2.0, nan, ['a', 'b'])
        >>> print(rows.table(["case"], {"time": {"quantity": "ms"}, "memory": {"quantity": "MB"}}))
        | case | time | memory |
        | --- | --- | --- |
        | a | 1 |  |
        | b | 2 | 3.5 |
    """

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

    def table(self, index: Sequence[str], columns: Mapping[str, Column]) -> str:
        """Lay out a Markdown table with a line for each combination of the index fields that occurs.

        Args:
            index: fields in the first columns.
            columns: by header.
        """
        lines = []
        for key in product(*(self.names(field) for field in index)):
            line = self.select(**dict(zip(index, key, strict=True)))
            if line:
                cells = [column(line) if callable(column) else line.value(**column) for column in columns.values()]
                lines.append([*map(str, key), *(c if isinstance(c, str) else number(c) for c in cells)])
        return markdown([*index, *columns], lines)


# fields of the number that a cell holds, or a function of the line's rows
Column = Mapping[str, object] | Callable[[Readings], float | str]
