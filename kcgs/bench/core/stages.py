"""The fits of an experiment, stage by stage, and what becomes of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from .cases import BEST, Case, Method
from .jobs import check_made
from .options import Options
from .report import Report, conclude
from .rivals import approach, rivals
from .rows import write_rows
from .store import Row, Store

# called with the report's folder, the store and the cases; makes figures that need scenes, returns more rows
Finish = Callable[[Path, Store, Sequence[Case]], Sequence[Row]]


def run_stages(
    name: str,
    report: Report,
    output: Path,
    options: Options,
    stages: Sequence[Sequence[Case]],
    *,
    matched: Sequence[Method] = (),
    finish: Finish | None = None,
    share: float = 1.0,
) -> None:
    """Make what is missing, stage after stage, then results.csv and the report of what is there.

    Every finished fit is kept, so that the same call goes on where an earlier one was interrupted.

    Args:
        name: of the experiment.
        report: of the experiment.
        output: folder.
        options: of the experiment.
        stages: cases; the budget sees the first stage first.
        matched: methods of which also files of about as many bytes as those of `best` are made.
        finish: is called when all is made that will be.
        share: of the budget that fits get.

    Raises:
        ValueError: numbers out of range.
        RuntimeError: fits failed; the others are kept, and in the report.
    """
    options.check()
    store, wanted = Store.open(output, options), [case for stage in stages for case in stage]
    deadline = options.deadline(share)
    failed: list[str] = []
    try:
        for stage in stages:
            failed += store.obtain(stage, options.place, deadline)
            for other in matched:
                failed += approach(store, stage, BEST, other, options.place, deadline)
    finally:
        rows = store.rows(wanted)
        extra = [*store.rows(case for other in matched for case in rivals(store, wanted, BEST, other))]
        extra += finish(output, store, wanted) if finish is not None and rows else []
        write_rows(output / "results.csv", Row, [*rows, *extra], ["bits_per_pixel"])
        conclude(report, output, options.made(name, _notes(rows, wanted, options)))
    check_made(failed)


def _notes(rows: Sequence[Row], wanted: Sequence[Case], options: Options) -> list[str]:
    """Say what of the planned cases is not there, and that fits may be another bench's."""
    shared = "Fits are shared with the other benches, which may have made them."
    notes = [] if options.runs is None else [shared]
    present = {(row.image, row.n, row.method, row.seed) for row in rows}
    lacking = [case for case in wanted if (case.image, case.n, case.method.name, case.seed) not in present]
    if not lacking:
        return notes
    parts = []
    for n in sorted({case.n for case in lacking}):
        names = [case.image for case in lacking if case.n == n]
        images = list(dict.fromkeys(names))
        more = f" and {len(images) - 4} more images" if len(images) > 4 else ""
        parts.append(f"N = {n:,}: {len(names)} of {', '.join(images[:4])}{more}")
    budget = options.budget_seconds
    over = "" if budget is None else f" the budget of {budget:,.0f} s was over, or"
    why = f"Missing, for{over} the run was stopped: {len(lacking)} of {len(wanted)} fits"
    return [*notes, f"{why}: {'; '.join(parts)}."]
