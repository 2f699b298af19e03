"""The fits, one after the other, and what becomes of them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from kcgs._atomic import atomic_path

from .report import write
from .trials import Result, Scenes, Trial, plan

_GAINS = ("gain", "ef_gain", "equal_gain", "equal_ef_gain")


def run(output: Path, *, data: Path | None = None, quick: bool = False) -> None:
    """Fit with automatic maps and without; write results.csv, report.md and gains.png.

    Every finished fit is kept in `output`/runs as a scene, so that the same call goes on where an earlier one was
    interrupted. Remove the folder to measure changed code anew.

    Args:
        output: folder.
        data: folder with bsds in it; None: one photo is all there is.
        quick: two pictures, half as large, and few iterations.

    Raises:
        ValueError: there are no pictures in the data.
    """
    from rich.console import Console
    from rich.progress import Progress

    trials = plan(data, quick)
    scenes = Scenes(output / "runs", data)
    console = Console(stderr=True)
    try:
        with Progress(console=console, disable=not console.is_terminal) as progress:
            task = progress.add_task("", total=len(trials))

            def obtain(trial: Trial) -> None:
                progress.update(task, description=f"{trial.image}, N = {trial.n:,}, map: {trial.source}")
                if not scenes.has(trial):
                    scenes.make(trial)

            for trial in trials:
                obtain(trial.baseline())
                obtain(trial)
                rival = scenes.equal_bytes(trial)
                if rival is not None:
                    obtain(rival)
                progress.advance(task)
    finally:
        results = [result for trial in trials if (result := scenes.result(trial)) is not None]
        _write_csv(output / "results.csv", results)
        write(output, results, planned=len(trials), quick=quick)
    Console().print(f"{output}/report.md")


def _write_csv(path: Path, results: Sequence[Result]) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*Result._fields, *_GAINS])
        for result in results:
            values = [*result, *(getattr(result, name) for name in _GAINS)]
            writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in values])
