"""The tables of docs/results.md, from the committed results.csv files: `python -m benchmarks.core.pages`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kcgs._atomic import write_file

from . import summaries
from .cases import BASELINE, BEST, CLAMPED, PAPER, UNCLAMPED
from .compare import Contest
from .rows import read_rows
from .store import Row

BEGIN, END = "<!-- results: made by `make report` -->", "<!-- end of results -->"
_TITLES = {
    "davis": "DAVIS first frames",
    "charts": "Colour charts",
    "ablation": "What each part brings",
    "convergence": "Against run time, and other codecs at the same bytes",
}
_CONTESTS = tuple(Contest(BEST.name, other.name) for other in (BASELINE, PAPER, UNCLAMPED, CLAMPED))
_COLUMNS = ("N left", "PSNR", "EF-PSNR", "bits per pixel", "PSNR decoded", "core s")


def results(reports: Path) -> str:
    """Write the tables of all reports, NAME/results.csv, that are there."""
    parts = []
    for name, title in _TITLES.items():
        rows = read_rows(reports / name / "results.csv", Row)
        images = list(dict.fromkeys(row.image for row in rows))
        made = f"Made by `python -m benchmarks {name}`: [its report](../benchmarks/reports/{name}/report.md)."
        parts += [f"## {title}", made] if rows else []
        # two charts are no sample of images: no means
        for group in [[image] for image in images] if name == "charts" else [images][: len(rows)]:
            words = f"{len(group)} images, {', '.join(group)}" if len(group) > 1 else f"One image, {group[0]}"
            of_group = [row for row in rows if row.image in group]
            shown = of_group if name == "charts" else [row for row in of_group if row.n in _compared(rows)]
            methods = list(dict.fromkeys(row.method for row in shown))
            parts += [f"{words}.", summaries.means(shown, methods, _COLUMNS)]
        parts.append(summaries.short_runs(rows))
        if name == "davis" and rows:
            parts.append("Differences, paired by image, with bootstrap intervals where there are enough:")
            parts.append(summaries.differences(rows, _CONTESTS, _compared(rows), ("psnr", "ef_psnr")))
    return "\n\n".join(filter(None, parts))


def put(page: str, text: str) -> str:
    """Return the page with these tables between the marks; a ValueError where they are not there."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"the page must have {BEGIN!r} and {END!r}")
    return f"{before}{BEGIN}\n{text}\n{END}{after}"


def _compared(rows: Sequence[Row]) -> list[int]:
    """Return the N of more than one method; those that only one has are points of its curve."""
    methods = {n: {row.method for row in rows if row.n == n} for n in sorted({row.n for row in rows})}
    return [n for n, names in methods.items() if len(names) > 1]


def main() -> None:
    """Put the tables into docs/results.md of the current folder."""
    path = Path("docs/results.md")
    write_file(path, put(path.read_text(encoding="utf-8"), results(Path("benchmarks/reports"))))


if __name__ == "__main__":
    main()
