"""The tables of docs/results.md, from the committed results.csv files: `python -m kcgs.bench.paper.readme`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kcgs._atomic import atomic_path
from kcgs.bench.cells import count, db, markdown, seconds

from . import tables
from .compare import complete, mean, select
from .methods import BASELINE, BEST, CLAMPED, FULL_ITERATIONS, PAPER, PUBLISHED, UNCLAMPED
from .report import read_rows
from .tables import Contest
from .trials import Row

BEGIN, END = "<!-- results: made by `make report` -->", "<!-- end of results -->"
_TITLES = {
    "davis": "DAVIS first frames",
    "charts": "Colour charts",
    "ablation": "What each part is worth",
    "convergence": "Against run time, and other codecs at the same bytes",
}
_CONTESTS = tuple(Contest(BEST.name, other.name) for other in (BASELINE, PAPER, UNCLAMPED, CLAMPED))


def results(reports: Path) -> str:
    """Write the tables of all reports that are there.

    Args:
        reports: folder with NAME/results.csv in it.
    """
    parts = []
    for name, title in _TITLES.items():
        path = reports / name / "results.csv"
        rows = read_rows(path) if path.is_file() else []
        if rows:
            parts.append(f"**{title}** (`kcgs bench {name}`, `notebooks/reports/{name}/report.md`):")
            # two charts are no sample of pictures: no means
            groups = _by_picture(rows) if name == "charts" else [rows]
            parts += [f"{_pictures(group).capitalize()}.\n\n{_table(group, name == 'charts')}" for group in groups]
            parts.append(_caveat(rows))
            if name == "davis":
                parts.append("Differences, paired by picture, with bootstrap intervals where there are enough:")
                parts.append(tables.differences(rows, _CONTESTS, _compared(rows), ("psnr", "ef_psnr")))
    return "\n\n".join(filter(None, parts))


def put(page: str, text: str) -> str:
    """Return the page with these tables between the marks.

    Raises:
        ValueError: the marks are not there.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"the page must have {BEGIN!r} and {END!r}")
    return f"{before}{BEGIN}\n{text}\n{END}{after}"


def main() -> None:
    """Put the tables into docs/results.md of the current folder."""
    path = Path("docs/results.md")
    text = put(path.read_text(encoding="utf-8"), results(Path("notebooks/reports")))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _by_picture(rows: Sequence[Row]) -> list[list[Row]]:
    names = dict.fromkeys(row.picture for row in rows)
    return [[row for row in rows if row.picture == name] for name in names]


def _pictures(rows: Sequence[Row]) -> str:
    names = list(dict.fromkeys(row.picture for row in rows))
    return f"{len(names)} pictures, {', '.join(names)}" if len(names) > 1 else f"one picture, {names[0]}"


def _methods(rows: Sequence[Row], n: int) -> list[str]:
    return list(dict.fromkeys(row.method for row in rows if row.n == n))


def _caveat(rows: Sequence[Row]) -> str:
    """Say that published recipes ran shorter than they were published."""
    short = {r.iterations for r in rows if r.method in PUBLISHED and r.iterations < FULL_ITERATIONS}
    if not short:
        return ""
    ran = " or ".join(f"{iterations:,}" for iterations in sorted(short))
    return f"Published recipes ran {ran} of their {FULL_ITERATIONS:,} iterations: differences to them are not final."


def _compared(rows: Sequence[Row]) -> list[int]:
    """Return the N of more than one method; those that only one has are points of its curve."""
    return [n for n in sorted({row.n for row in rows}) if len(_methods(rows, n)) > 1]


def _table(rows: Sequence[Row], of_one: bool) -> str:
    """Means over the pictures that every method of an N has; `of_one` picture, the N of a single method too."""
    header = ["N", "N left", "method", "iterations", "pictures"]
    header += ["PSNR", "EF-PSNR", "bits per pixel", "PSNR decoded", "core s"]
    lines = []
    for n in sorted({row.n for row in rows}) if of_one else _compared(rows):
        methods = _methods(rows, n)
        shared = complete(rows, methods, n)
        for method in methods if shared else ():
            found = [row for row in select(rows, method, n) if row.picture in shared]
            # other codecs have neither Gaussians nor iterations
            counts = (n, mean(row.num_gaussians for row in found), found[0].iterations)
            asked, left, iterations = (count(value) if n else "" for value in counts)
            line = [asked, left, f"`{method}`", iterations, str(len(shared))]
            line += [db(mean(row.psnr for row in found)), db(mean(row.ef_psnr for row in found))]
            line.append(f"{mean(row.bits_per_pixel for row in found):.3f}")
            line += [db(mean(row.decoded_psnr for row in found)), seconds(mean(row.core_seconds for row in found))]
            lines.append(line)
    return markdown(header, lines)


if __name__ == "__main__":
    main()
