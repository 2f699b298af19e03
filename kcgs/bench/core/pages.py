"""The tables of docs/results.md, from the committed results.csv files: `python -m kcgs.bench.core.pages`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kcgs._atomic import atomic_path

from . import summaries
from .cases import BASELINE, BEST, CLAMPED, PAPER, PUBLISHED, UNCLAMPED, method
from .compare import Contest, complete, mean_over, select
from .rows import read_rows
from .store import Row
from .tables import count, markdown

BEGIN, END = "<!-- results: made by `make report` -->", "<!-- end of results -->"
_TITLES = {
    "davis": "DAVIS first frames",
    "charts": "Colour charts",
    "ablation": "What each part brings",
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
        rows = read_rows(reports / name / "results.csv", Row)
        images = list(dict.fromkeys(row.image for row in rows))
        made = f"Made by `kcgs bench {name}`: [its report](../notebooks/reports/{name}/report.md)."
        parts += [f"## {title}", made] if rows else []
        # two charts are no sample of images: no means
        for group in [[image] for image in images] if name == "charts" else [images][: len(rows)]:
            words = f"{len(group)} images, {', '.join(group)}" if len(group) > 1 else f"One image, {group[0]}"
            parts += [f"{words}.", _table([row for row in rows if row.image in group], name == "charts")]
        parts.append(_caveat(rows))
        if name == "davis" and rows:
            parts.append("Differences, paired by image, with bootstrap intervals where there are enough:")
            parts.append(summaries.differences(rows, _CONTESTS, _compared(rows), ("psnr", "ef_psnr")))
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


def _caveat(rows: Sequence[Row]) -> str:
    """Say that published recipes ran shorter than they were published."""
    ran = {(row.iterations, method(row.method).config().iterations) for row in rows if row.method in PUBLISHED}
    short = " or ".join(f"{count(own)} of their {count(full)}" for own, full in sorted(ran) if own < full)
    return f"Published recipes ran {short} iterations: differences to them are not final." if short else ""


def _compared(rows: Sequence[Row]) -> list[int]:
    """Return the N of more than one method; those that only one has are points of its curve."""
    methods = {n: {row.method for row in rows if row.n == n} for n in sorted({row.n for row in rows})}
    return [n for n, names in methods.items() if len(names) > 1]


def _table(rows: Sequence[Row], of_one: bool) -> str:
    """Means over the images that every method of an N has; `of_one` image, the N of a single method too."""
    header = ["N", "N left", "method", "iterations", "images"]
    header += ["PSNR", "EF-PSNR", "bits per pixel", "PSNR decoded", "core s"]
    lines = []
    for n in sorted({row.n for row in rows}) if of_one else _compared(rows):
        methods = list(dict.fromkeys(row.method for row in rows if row.n == n))
        shared = complete(rows, methods, n)
        for name in methods if shared else ():
            found = select(rows, name, n, shared)
            # other codecs have neither Gaussians nor iterations
            counts = (n, mean_over(found, "num_gaussians"), found[0].iterations)
            asked, left, iterations = (count(value) if n else "" for value in counts)
            line = [asked, left, f"`{name}`", iterations, str(len(shared))]
            fields = ("psnr", "ef_psnr", "bits_per_pixel", "decoded_psnr", "core_seconds")
            lines.append([*line, *summaries.means(found, fields)])
    return markdown(header, lines)


def main() -> None:
    """Put the tables into docs/results.md of the current folder."""
    path = Path("docs/results.md")
    text = put(path.read_text(encoding="utf-8"), results(Path("notebooks/reports")))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
