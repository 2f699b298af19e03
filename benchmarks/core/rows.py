"""Results as named tuples in a CSV file: the columns are the fields."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar, cast, get_type_hints

from kcgs._atomic import atomic_path

Record = TypeVar("Record", bound=NamedTuple)


def write_rows(path: Path, kind: type[NamedTuple], rows: Iterable[NamedTuple], derived: Sequence[str] = ()) -> None:
    """Write rows, floats with six digits; properties named by `derived` get a column that is not read back."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = [*kind._fields, *derived]
        writer.writerow(names)
        for row in rows:
            values = [getattr(row, name) for name in names]
            writer.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in values])


def read_rows(path: Path, kind: type[Record]) -> list[Record]:
    """Read what `write_rows` wrote; a column that is missing has its field's default, and no file means no rows."""
    if not path.is_file():
        return []
    types, make = get_type_hints(kind), cast("Callable[..., Record]", kind)
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    return [make(**{name: types[name](line[name]) for name in kind._fields if name in line}) for line in lines]
