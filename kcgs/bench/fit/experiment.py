"""The fits, and what becomes of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from kcgs.bench.cells import write_csv
from kcgs.bench.fits import HERE, Place, check_made, make_all

from .cases import GROUPS, TIMED, Case, cases, missing
from .report import write
from .runs import Run, Store, equal_bytes, perform


def run(
    output: Path, *, data: Path | None = None, quick: bool = False, only: str | None = None, place: Place = HERE
) -> None:
    """Race the recipes; write results.csv, report.md and figures.

    Every finished fit is kept in `output`/runs, so that the same call goes on where an earlier one was interrupted;
    the report is of all runs there that have the present settings. Remove the folder to measure changed code anew.

    Args:
        output: folder.
        data: folder with DAVIS, bsds and kodak in it; None: the charts and one photo are all there is.
        quick: one picture for each group, half as large, and few iterations.
        only: names of groups with commas between them; None: all that can be run.
        place: where the fits are made; those of the groups `TIMED` are made one after another in this process.

    Raises:
        ValueError: `only` names no group, or one whose pictures are missing.
        RuntimeError: fits failed; the others are kept, and in the report.
    """
    from rich.console import Console

    chosen = _choose(only, data)
    store = Store(output.absolute() / "runs")
    data = None if data is None else data.absolute()
    waiting = [case for group in chosen for case in cases(group, data, quick)]
    for case in waiting:
        case.config()  # read before hours of work: a recipe may be wrong, or edited meanwhile
    failed: list[str] = []
    try:
        for timed in (False, True):
            here = HERE if timed else place
            part = [case for case in waiting if (case.group in TIMED) == timed]
            failed += _obtain(store, part, data, here)
            rivals = [equal_bytes(case, made) for case in part if (made := store.read(case)) is not None]
            failed += _obtain(store, [rival for rival in rivals if rival is not None], data, here)
    finally:
        _report(output, store, data, quick, chosen, place)
    check_made(failed)
    Console().print(f"{output}/report.md")


def _obtain(store: Store, wanted: list[Case], data: Path | None, place: Place) -> list[str]:
    # by key, for a case holds a dict: the baseline at equal bytes may be that of two recipes
    missing = {case.key(): case for case in wanted if store.read(case) is None}

    def name(case: Case) -> str:
        return f"{case.group}: {case.image}, N = {case.n:,}, {case.name}"

    return make_all(partial(_perform, store, data), list(missing.values()), place, name=name)


def _choose(only: str | None, data: Path | None) -> list[str]:
    if only is None:
        return [group for group in GROUPS if missing(group, data) is None]
    names = [name.strip() for name in only.split(",")]
    for name in names:
        if name not in GROUPS:
            raise ValueError(f"only must name groups of {', '.join(GROUPS)}, with commas; got {only!r}")
        why = missing(name, data)
        if why is not None:
            raise ValueError(f"only asks for {name!r}, but {why}")
    return [group for group in GROUPS if group in names]


def _perform(store: Store, data: Path | None, case: Case) -> None:
    store.write(case, perform(case, data))


def _with_equal_bytes(case: Case, obtain: Callable[[Case], Run | None]) -> Iterator[tuple[Case, Run]]:
    """Yield the run of a case and the baseline's at equal bytes, as far as they can be had."""
    made = obtain(case)
    if made is None:
        return
    yield case, made
    other = equal_bytes(case, made)
    rival = None if other is None else obtain(other)
    if other is not None and rival is not None:
        yield other, rival


def _report(output: Path, store: Store, data: Path | None, quick: bool, chosen: list[str], place: Place) -> None:
    runs: dict[str, Run] = {}  # by key: the baseline at equal bytes may be that of two recipes
    notes = []
    for group in GROUPS:
        why = missing(group, data)
        if why is not None:
            notes.append(f"{group}: {why}.")
            continue
        wanted = cases(group, data, quick)
        made = [list(_with_equal_bytes(case, store.read)) for case in wanted]
        runs |= {case.key(): run for found in made for case, run in found}
        count = sum(bool(found) for found in made)
        if count < len(wanted):
            why = "stopped before its end" if group in chosen else "not chosen"
            notes.append(f"{group}: {why}, {count} of {len(wanted)} fits are there.")
    _write_csv(output / "results.csv", list(runs.values()))
    write(output, list(runs.values()), notes, quick, place)


def _write_csv(path: Path, runs: list[Run]) -> None:
    names = [field.name for field in dataclasses.fields(Run) if field.name != "history"]
    names.append("bytes")
    write_csv(path, names, ([getattr(run, name) for name in names] for run in runs))
