"""The table of `kcgs fit-many`: a row an image, on disk as soon as it is known."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from kcgs._atomic import atomic_path

FIGURES = (
    *("psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim"),
    *("num_gaussians", "seconds", "bytes", "bits_per_pixel"),
)
COLUMNS = ("image", *FIGURES, "error", "core_seconds", "fit")


class Table:
    """Rows by the stem of their image; those of an earlier call are kept."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: dict[str, dict[str, str]] = {}
        if path.is_file():
            with path.open(newline="", encoding="utf-8") as file:
                # a row that was cut off by a kill is not there
                rows = [row for row in csv.DictReader(file) if set(row) == set(COLUMNS) and None not in row.values()]
            self._rows = {Path(row["image"]).stem: row for row in rows}
        self.write()

    def get(self, image: Path) -> dict[str, str]:
        """Return an image's row, empty where there is none."""
        return self._rows.get(image.stem, {})

    def put(self, image: Path, **values: Any) -> None:
        """Set an image's row, and write it down at once; what is not said is left empty."""
        row = {"image": str(image), **{name: _text(values.get(name, "")) for name in COLUMNS[1:]}}
        self._rows[image.stem] = row
        with self._path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, COLUMNS).writerow(row)

    def write(self) -> None:
        """Write the table anew, sorted, one row an image: appended rows are in the order in which fits end."""
        with atomic_path(self._path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(self._rows[stem] for stem in sorted(self._rows))

    def column(self, name: str, images: list[Path]) -> list[float]:
        """Return the numbers of a column, where there are any."""
        return [float(text) for image in images if (text := self.get(image).get(name))]


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return str(value)
