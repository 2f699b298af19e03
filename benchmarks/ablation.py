"""The paper's ablation, and ours below it: `python -m benchmarks ablation`."""

from __future__ import annotations

from pathlib import Path

from .core import summaries
from .core.cases import BASELINE, BEST, CLAMPED, PAPER, PUBLISHED_ITERATIONS, UNCLAMPED, Case, method, plan
from .core.compare import Contest, mean_over, select, shared
from .core.images import sequences
from .core.options import Options
from .core.registry import experiment
from .core.report import Made
from .core.rows import read_rows
from .core.stages import run_stages
from .core.store import Row
from .core.tables import count, db, markdown, signed

COUNTS = (1_250, 7_500)
QUICK_COUNTS = (40,)
QUICK_STRIDE = 4

GUIDED = method("guidance, clamp", "paper", warmup=False, clamp=True)
GUIDED_UNCLAMPED = method("guidance + no clamp", "paper", warmup=False)
WARMED = method("guidance + warm-up, clamp", "paper", clamp=True)
PAPER_ROWS = (CLAMPED, UNCLAMPED, GUIDED, GUIDED_UNCLAMPED, WARMED, PAPER)
OUR_ROWS = (
    BEST,
    method("best without k-means start", "best", initializer="random"),
    method("best without densification", "best", densify_from=1.0),
    method("best without soft contours", "best", softness=0.0),
    method("best with L1 loss", "best", loss="l1"),
    method("best with contours as given", "best", move_contours=False, merge_regions=False),
    BASELINE,
)
METHODS = (*PAPER_ROWS, *OUR_ROWS)
CONTESTS = (
    *(Contest(m.name, CLAMPED.name) for m in PAPER_ROWS[1:]),
    *(Contest(BEST.name, m.name) for m in OUR_ROWS[1:]),
)
# what the paper prints, PSNR and EF-PSNR by N: over all of DAVIS, 50,000 iterations
PRINTED = {
    CLAMPED.name: {1_250: (27.10, 22.73), 7_500: (33.41, 30.33)},
    UNCLAMPED.name: {1_250: (27.29, 22.92), 7_500: (33.57, 30.48)},
    GUIDED.name: {1_250: (26.98, 22.72), 7_500: (33.25, 29.36)},
    GUIDED_UNCLAMPED.name: {1_250: (27.15, 22.92), 7_500: (33.20, 29.31)},
    WARMED.name: {1_250: (27.06, 23.09), 7_500: (33.28, 29.44)},
    PAPER.name: {1_250: (27.31, 23.41), 7_500: (33.44, 29.18)},
}
_PAPER_TEXT = """Columns marked *theirs* are what the paper prints, means over all of DAVIS at 50,000 iterations;
nobody measured them here. Changes are to the first row."""
_OUR_TEXT = (
    "Parts of the paper's method against its clamped baseline, then `best` against `best` with a part taken away."
)


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    rows = read_rows(output / "results.csv", Row)
    parts = ["# Ablation", summaries.what_was_run(rows)]
    if not rows:
        return parts
    parts += ["## Where a part does harm", summaries.losses(rows, CONTESTS)]
    parts += ["## The paper's rows", _PAPER_TEXT, paper_table(rows)]
    parts += ["## Differences", _OUR_TEXT, summaries.differences(rows, CONTESTS)]
    return [*parts, "## Means", summaries.means(rows, [m.name for m in METHODS])]


@experiment("engine", "workers", "sequences", "budget_seconds", "seeds", "iterations", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Fit every row on first frames; with a budget, a sequence has all rows at 1,250 before the next."""
    names = sequences(options.data, options.sequences, quick=options.quick)
    run_stages("ablation", report, output, options, [cases(names, options)])


def cases(names: list[str], options: Options) -> list[Case]:
    """List the fits, all sequences at the smaller N first."""
    names, counts = (names[:1], QUICK_COUNTS) if options.quick else (names, COUNTS)
    # a budget sees those first that are done soonest
    methods = (*OUR_ROWS, *PAPER_ROWS)
    return [c for n in counts for c in plan(names, (n,), methods, options, PUBLISHED_ITERATIONS, QUICK_STRIDE)]


def paper_table(rows: list[Row]) -> str:
    """Our means beside the printed ones."""
    header = ["N", "row", "images", "PSNR", "change", "EF-PSNR", "change"]
    header += ["theirs: PSNR", "theirs: change", "theirs: EF-PSNR", "theirs: change"]
    lines = []
    for n, present, images in shared(rows, [m.name for m in PAPER_ROWS]):
        first = select(rows, CLAMPED.name, n, images)
        for name in present:
            found = select(rows, name, n, images)
            line = [count(n), f"`{name}`", str(len(images))]
            for quantity in ("psnr", "ef_psnr"):
                value = mean_over(found, quantity)
                line += [db(value), signed(value - mean_over(first, quantity))]
            lines.append([*line, *_printed(name, n)])
    return markdown(header, lines)


def _printed(name: str, n: int) -> list[str]:
    if n not in PRINTED[name]:
        return [""] * 4
    pairs = zip(PRINTED[name][n], PRINTED[CLAMPED.name][n], strict=True)
    return [cell for value, base in pairs for cell in (db(value), signed(value - base))]
