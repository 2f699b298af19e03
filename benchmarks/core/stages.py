"""The fits of an experiment, stage by stage, and what becomes of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path

from .cases import BEST, Case, Method
from .jobs import check_made
from .options import Options
from .report import Report, conclude
from .rows import write_rows
from .store import Row, Store

# called with the report's folder, the store and the cases; makes figures that need scenes, returns more rows
Finish = Callable[[Path, Store, Sequence[Case]], Sequence[Row]]
# what files of about as many bytes are aimed at, may have, and how many fits that may take
_ABOVE, _NEAR, _TRIES = 1.03, 1.06, 4


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

    Every finished fit is kept, so that the same call goes on where an earlier one was interrupted. Of the `matched`
    methods also files of about as many bytes as those of `best` are made; fits get a `share` of the budget.
    """
    options.check()
    store, wanted = Store.open(output, options), [case for stage in stages for case in stage]
    deadline = options.deadline(share)
    failed: list[str] = []
    try:
        for stage in stages:
            failed += store.obtain(stage, options.place, deadline)
            for case in stage:
                store.look(case)
            for other, _ in product(matched, range(_TRIES)):
                failed += [] if failed else store.obtain(rivals(store, stage, BEST, other), options.place, deadline)
    finally:
        rows = store.rows(wanted)
        extra = [*store.rows(case for other in matched for case in rivals(store, wanted, BEST, other))]
        extra += finish(output, store, wanted) if finish is not None and rows else []
        write_rows(output / "results.csv", Row, [*rows, *extra], ["bits_per_pixel"])
        conclude(report, output, options.made(name, _notes(rows, wanted, options)))
    check_made(failed)


def _notes(rows: Sequence[Row], wanted: Sequence[Case], options: Options) -> list[str]:
    """Say what of the planned cases is not there, and that fits may be another bench's."""
    notes = [] if options.runs is None else ["Fits are shared with the other benches, which may have made them."]
    present = {(row.image, row.n, row.method, row.seed) for row in rows}
    lacking = [case for case in wanted if (case.image, case.n, case.method.name, case.seed) not in present]
    if lacking:
        counts = ", ".join(f"{n:,}" for n in sorted({case.n for case in lacking}))
        which = f"{len(lacking)} of {len(wanted)} fits, at N = {counts}"
        notes.append(f"Missing, for the budget was over or the run was stopped: {which}.")
    return notes


def rivals(store: Store, cases: Iterable[Case], ours: Method, other: Method) -> list[Case]:
    """Return fits of the other method with about the Gaussians that the bytes of ours buy.

    They are found one after another: those that are made already, and of each at most one that is not.
    """
    cases = list(dict.fromkeys(cases))
    found = []
    others = {(case.image, case.n, case.seed): case for case in cases if case.method == other}
    for case in cases:
        beside = others.get((case.image, case.n, case.seed))
        if case.method == ours and beside is not None:
            row, first = store.row(case), store.row(beside)
            if row is not None and first is not None:
                found += _approach(store, beside, first, row.bytes)
    return found


def _approach(store: Store, first: Case, row: Row, size: int) -> list[Case]:
    """Return fits ever nearer to `size` bytes, until one has as many, or little more, or is not made yet."""
    made, found = {row.n: row.bytes}, list[Case]()
    while len(found) < _TRIES and not any(size <= count <= _NEAR * size for count in made.values()):
        case = first._replace(n=_guess(made, _ABOVE * size))
        if case.n in made:
            break
        found.append(case)
        reached = store.row(case)
        if reached is None:
            break
        made[case.n] = reached.bytes
    return found


def _guess(made: dict[int, int], size: float) -> int:
    """Return the N of so many bytes, by the line through the two nearest files, or through the only one and nothing."""
    (n, count), (other, beside) = sorted([*made.items(), (0, 0)], key=lambda point: abs(point[1] - size))[:2]
    return n + 1 if count == beside else max(1, 1 + math.ceil(n + (size - count) * (n - other) / (count - beside)))
