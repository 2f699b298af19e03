"""Tables of means: how columns are named and formatted, rows grouped, and tables laid out."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from statistics import fmean
from typing import Any, NamedTuple

from .run import Row


class Column(NamedTuple):
    """A column of rows, as tables show it."""

    title: str
    format: str
    tie: float = 0.0
    """The largest difference that is no difference, where methods are compared."""
    less_is_better: bool = False


# other columns have their own name as the title, and three digits
COLUMNS = {
    "n": Column("N", ",.0f"),
    "target_bytes": Column("target bytes", ",.0f"),
    "bytes": Column("bytes", ",.0f", 0.5, less_is_better=True),
    "map_bytes": Column("of these map", ",.0f", 0.5),
    "regions": Column("regions", ".1f"),
    "budget": Column("seconds", ",.0f"),
    "iterations": Column("iterations", ",.0f"),
    "bpp": Column("bits per pixel", ".3f", 0.0005),
    "psnr": Column("PSNR", ".2f", 0.005),
    "ms_ssim": Column("MS-SSIM", ".4f", 0.0001),
    "ef_psnr": Column("EF-PSNR", ".2f", 0.005),
    "ssimulacra2": Column("SSIMULACRA2", ".1f", 0.05),
    "delta_e": Column("deltaE 2000", ".2f", 0.005, less_is_better=True),
    "butteraugli": Column("butteraugli", ".1f", 0.05, less_is_better=True),
    "decoded_psnr": Column("PSNR decoded", ".2f", 0.005),
    "decoded_ef_psnr": Column("EF-PSNR decoded", ".2f", 0.005),
    "core_seconds": Column("seconds of a core", ".1f", 0.05, less_is_better=True),
    "iou": Column("IoU", ".2f", 0.005),
    "good": Column("good", ".0%"),
    "failed": Column("failed", ".0%", less_is_better=True),
    "seconds": Column("seconds", "", less_is_better=True),
    "batch": Column("images in a batch", ",.0f"),
    "images_per_second": Column("images per second", ""),
    "forward_ms": Column("forward, ms", "", less_is_better=True),
    "both_ms": Column("forward and backward, ms", "", less_is_better=True),
    "captured_forward_ms": Column("forward captured, ms", "", less_is_better=True),
    "captured_both_ms": Column("both captured, ms", "", less_is_better=True),
    "flicker": Column("flicker", ".2f", 0.005, less_is_better=True),
    "steep": Column("steep", "", less_is_better=True),
    "beyond [0, 1]": Column("beyond [0, 1]", "", less_is_better=True),
}


def column_of(name: str) -> Column:
    """Return how tables show a column."""
    return COLUMNS.get(name, Column(name.replace("_", " "), ""))


def is_missing(value: Any) -> bool:
    """True where a row has no number."""
    return not isinstance(value, int | float) or math.isnan(value)


def values_of(rows: Iterable[Row], name: str) -> list[float]:
    """Return the numbers of a column."""
    return [row[name] for row in rows if not is_missing(row.get(name))]


def group_by(rows: Iterable[Row], names: Sequence[str]) -> dict[tuple[object, ...], list[Row]]:
    """Group rows by their values of these columns, in order of appearance."""
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row.get(name) for name in names)].append(row)
    return groups


def title(name: str) -> str:
    """Return the title of a column."""
    return column_of(name).title


def format_value(name: str, value: Any, sign: str = "") -> str:
    """Format a value of a column; a text stays, a missing number is empty."""
    if isinstance(value, str):
        return value
    if is_missing(value):
        return ""
    default = ",.0f" if abs(value) >= 100 else ".3g"
    return format(value, sign + (column_of(name).format or default))


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Lay out a table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [header, ["---"] * len(header), *lines])


def means_table(
    rows: Sequence[Row], names: Sequence[str], along: str, quantities: Sequence[str], sign: str = ""
) -> str:
    """Lay out means, a line for each combination of names, a column for each value along, quantities as "a / b".

    A mean of fewer images than others of its line has their number behind it.
    """
    values = list(group_by(rows, [along])) if along else []
    lines = []
    for key, group in group_by(rows, names).items():
        if along:
            by_value = group_by(group, [along])
            parts = [by_value.get(value, []) for value in values]
            counts = [len(group_by(part, ["image"])) for part in parts]
            cells = [
                " / ".join(filter(None, _mean_cells(part, quantities, sign)))
                + (f" ({count})" if 0 < count < max(counts) else "")
                for part, count in zip(parts, counts, strict=True)
            ]
        else:
            cells = _mean_cells(group, quantities, sign)
        lines.append([*map(format_value, names, key), *cells])
    header = [_column_header(along, value) for (value,) in values] if along else map(title, quantities)
    return markdown([*map(title, names), *header], lines)


def _column_header(name: str, value: Any) -> str:
    return value if isinstance(value, str) else f"{title(name)} = {format_value(name, value)}"


def _mean_cells(rows: Sequence[Row], quantities: Sequence[str], sign: str) -> list[str]:
    return [format_value(name, fmean(values), sign) if (values := values_of(rows, name)) else "" for name in quantities]


def join_sections(*texts: str) -> str:
    """Put tables and paragraphs, of which some are empty, below each other."""
    return "\n\n".join(filter(None, texts))


def join_tables(first: str, second: str) -> str:
    """Put the lines of a table under those of another with the same columns; either may be empty."""
    return "\n".join([first, *second.splitlines()[2:]]) if first else second
