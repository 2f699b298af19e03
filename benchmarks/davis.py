"""Quality against the number of Gaussians on first frames of DAVIS: `python -m benchmarks davis`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .core import figures, summaries
from .core.cases import BASELINE, BEST, CLAMPED, IMAGE_GS, PAPER, PUBLISHED_ITERATIONS, UNCLAMPED, Case, plan
from .core.compare import Contest, sweep
from .core.images import sequences
from .core.options import Options
from .core.registry import experiment
from .core.report import Made
from .core.rows import read_rows
from .core.stages import run_stages
from .core.store import Row, Store

METHODS = (BEST, BASELINE, PAPER, UNCLAMPED, CLAMPED, IMAGE_GS)
NAMES = tuple(m.name for m in METHODS)
# the two that the paper's table has come first
FIRST_COUNTS = (1_250, 7_500)
OTHER_COUNTS = (500, 2_500, 5_000, 10_000)
QUICK_COUNTS = (30, 60)
QUICK_STRIDE = 3
CONTESTS = (
    *(Contest(BEST.name, other.name) for other in (BASELINE, PAPER, UNCLAMPED, IMAGE_GS)),
    *(Contest(PAPER.name, other.name) for other in (UNCLAMPED, CLAMPED)),
    Contest(BASELINE.name, UNCLAMPED.name),
)
_EXTRA_TEXT = """For `best-baseline` files are made until one has as many bytes as that of `best`, or up to 6 % more, so
that the curve has a point there; the other curves have their points at the N above only, a coarse interpolation."""


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    rows = read_rows(output / "results.csv", Row)
    asked = [row for row in rows if row.n in (QUICK_COUNTS if made.quick else FIRST_COUNTS + OTHER_COUNTS)]
    parts = ["# DAVIS first frames: quality against the number of Gaussians", summaries.what_was_run(asked)]
    if not asked:
        return parts
    counts = sorted({row.n for row in asked})
    parts += ["## Where a method loses", summaries.losses(rows, CONTESTS, counts)]
    parts += ["## Differences", _EXTRA_TEXT, summaries.differences(rows, CONTESTS, counts)]
    parts += ["## Means", summaries.means(asked, NAMES)]
    figures.plot_against_n(output / "against-n.png", asked, NAMES)
    text = (
        f"Means over the sequences that all methods have at all N that are shown: {', '.join(sweep(asked, NAMES)[1])}."
    )
    return [*parts, text, "![](against-n.png)", *figures.show_crops(output, BEST.name)]


@experiment("engine", "workers", "sequences", "budget_seconds", "seeds", "iterations", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Sweep N on first frames; with a budget, a sequence has all methods at the paper's two N before the next."""
    names = sequences(options.data, options.sequences, quick=options.quick)
    run_stages("davis", report, output, options, _stages(names, options), matched=(BASELINE,), finish=_finish)


def _finish(output: Path, store: Store, wanted: Sequence[Case]) -> list[Row]:
    """Show where `best` is furthest from the photos at the first N, and its baseline there."""
    pairs = [(c, c._replace(method=BASELINE)) for c in wanted if c[1:4] == (wanted[0].n, BEST, 0)]
    pairs = [pair for pair in pairs if len(store.rows(pair)) == 2]
    frames = (
        (a.image, {"photo": a.load(store.data).image, **{c.method.name: store.scene(c).render() for c in (a, b)}})
        for a, b in pairs
    )
    figures.plot_crops(output / figures.CROPS, frames)
    return []


def _stages(names: list[str], options: Options) -> list[list[Case]]:
    first, rest = (QUICK_COUNTS, ()) if options.quick else (FIRST_COUNTS, OTHER_COUNTS)
    parts: list[tuple[tuple[int, ...], list[str]]] = [(first, names)]
    if options.budget_seconds is not None:
        parts = [(first, [name]) for name in names]
    parts += [((n,), names) for n in rest]
    return [plan(part, counts, METHODS, options, PUBLISHED_ITERATIONS, QUICK_STRIDE) for counts, part in parts]
