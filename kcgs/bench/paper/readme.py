"""The results that README.md shows, from the committed results.csv files: `python -m kcgs.bench.paper.readme`."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Sequence
from pathlib import Path

from kcgs._atomic import atomic_path
from kcgs.bench.cells import count, markdown

BEGIN, END = "<!-- results: made by `make report` -->", "<!-- end of results -->"
_TITLES = {
    "davis": "DAVIS first frames",
    "charts": "Colour charts",
}
Line = dict[str, str]


def results(reports: Path) -> str:
    """Write the tables of all reports that are there.

    Args:
        reports: folder with NAME/results.csv in it.
    """
    parts = []
    for name, title in _TITLES.items():
        path = reports / name / "results.csv"
        lines = _read(path) if path.is_file() else []
        if lines:
            parts.append(f"**{title}** (`kcgs bench {name}`, `notebooks/reports/{name}/report.md`):")
            # two charts are no sample of pictures: no means
            groups = _by_picture(lines) if name == "charts" else [lines]
            parts += [f"{_pictures(group).capitalize()}.\n\n{_table(group)}" for group in groups]
    return "\n\n".join(parts)


def put(readme: str, text: str) -> str:
    """Return the README with these results between the marks.

    Raises:
        ValueError: the marks are not there.
    """
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"README must have {BEGIN!r} and {END!r}")
    return f"{before}{BEGIN}\n{text}\n{END}{after}"


def main() -> None:
    """Put the results into the README of the current folder."""
    path = Path("README.md")
    text = put(path.read_text(encoding="utf-8"), results(Path("notebooks/reports")))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _read(path: Path) -> list[Line]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _by_picture(lines: Sequence[Line]) -> list[list[Line]]:
    names = dict.fromkeys(line["picture"] for line in lines)
    return [[line for line in lines if line["picture"] == name] for name in names]


def _pictures(lines: Sequence[Line]) -> str:
    names = list(dict.fromkeys(line["picture"] for line in lines))
    return f"{len(names)} pictures, {', '.join(names)}" if len(names) > 1 else f"one picture, {names[0]}"


def _table(lines: Sequence[Line]) -> str:
    """Means over the pictures that every method of an N has; N that only one method has are points of its curve."""
    header = ["N", "method", "iterations", "pictures", "PSNR", "EF-PSNR", "bits per pixel", "PSNR decoded"]
    rows = []
    for n in sorted({int(line["n"]) for line in lines}):
        here = [line for line in lines if int(line["n"]) == n]
        methods = list(dict.fromkeys(line["method"] for line in here))
        shared = set.intersection(*({line["picture"] for line in here if line["method"] == m} for m in methods))
        for method in methods if len(methods) > 1 else ():
            found = [line for line in here if line["method"] == method and line["picture"] in shared]
            if found:
                row = [count(n), f"`{method}`", count(int(found[0]["iterations"])), str(len(shared))]
                keys = (("psnr", 2), ("ef_psnr", 2), ("bits_per_pixel", 3), ("decoded_psnr", 2))
                rows.append(row + [f"{statistics.fmean(float(line[k]) for line in found):.{d}f}" for k, d in keys])
    return markdown(header, rows)


if __name__ == "__main__":
    main()
