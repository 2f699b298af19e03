"""The files, one after the other, and what becomes of them."""

from __future__ import annotations

from pathlib import Path

from kcgs.bench.cells import write_csv

from .codecs import present
from .groups import steps
from .pictures import GROUPS, SPEED, missing
from .points import Point, Store
from .report import write
from .workshop import Workshop


def run(output: Path, *, data: Path | None = None, quick: bool = False, only: str | None = None) -> None:
    """Compare files of kcgs with those of other codecs; write results.csv, summary.csv, report.md and figures.

    Every finished file is kept in `output`/files, so that the same call goes on where an earlier one was interrupted;
    those of kcgs are made anew once the codec has changed. Remove the folder to measure changed fits anew.

    Args:
        output: folder.
        data: folder with DAVIS, bsds and kodak in it; the short form needs none.
        quick: one small picture made by rule.
        only: names of groups with commas between them; None: all that can be run but `speed`, whose clocks want a
            machine with nothing else to do.

    Raises:
        ValueError: `only` names no group, or one whose pictures are missing; there is nothing to run.
    """
    from rich.console import Console
    from rich.progress import Progress

    chosen = _choose(only, data, quick)
    store = Store(output / "files")
    workshop = Workshop(store, data, quick)
    todo = [(f"{group}: {name}", step) for group in chosen for name, step in steps(group, workshop)]
    console = Console(stderr=True)
    try:
        with Progress(console=console, disable=not console.is_terminal) as progress:
            task = progress.add_task("", total=len(todo))
            for name, step in todo:
                progress.update(task, description=name)
                step()
                progress.advance(task)
    finally:
        _report(output, Workshop(store, data, quick, makes=False), chosen)
    Console().print(f"{output}/report.md")


def _choose(only: str | None, data: Path | None, quick: bool) -> list[str]:
    able = [group for group in GROUPS if quick or missing(group, data) is None]
    if only is None:
        if not able:
            raise ValueError("data must be a folder with DAVIS, bsds or kodak in it; without one there is only quick")
        return [group for group in able if quick or group != SPEED]
    wanted = [name.strip() for name in only.split(",")]
    for name in wanted:
        if name not in GROUPS:
            raise ValueError(f"only must name groups of {', '.join(GROUPS)}, with commas; got {only!r}")
        if name not in able:
            raise ValueError(f"only asks for {name!r}, but {missing(name, data)}")
    return [group for group in GROUPS if group in wanted]


def _report(output: Path, kept: Workshop, chosen: list[str]) -> None:
    points: list[Point] = []
    notes = []
    for group in GROUPS:
        why = None if kept.quick else missing(group, kept.data)
        if why is not None:
            notes.append(f"{group}: {why}.")
            continue
        todo, whole = list(steps(group, kept)), 0
        for _, step in todo:
            before = kept.missed
            found = step()
            # what there is of an unfinished step is shown all the same
            points += found
            whole += bool(found) and kept.missed == before
        if whole < len(todo):
            why = "stopped before its end" if group in chosen else "not chosen"
            notes.append(f"{group}: {why}, {whole} of {len(todo)} steps are finished.")
    write_csv(output / "results.csv", Point._fields, points)
    absent = [name for name in ("JPEG", "WebP", "AVIF") if name not in present()]
    notes += [f"This Pillow has no {name}." for name in absent]
    write(output, points, notes, kept.quick)
