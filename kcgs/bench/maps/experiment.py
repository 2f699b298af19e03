"""The fits, and what becomes of them."""

from __future__ import annotations

from pathlib import Path

from kcgs.bench.cells import write_csv
from kcgs.bench.fits import HERE, Place, check_made, make_all

from .report import write
from .trials import Result, Scenes, Trial, plan

_GAINS = ("gain", "ef_gain", "equal_gain", "equal_ef_gain")


def run(output: Path, *, data: Path | None = None, quick: bool = False, place: Place = HERE) -> None:
    """Fit with automatic maps and without; write results.csv, report.md and gains.png.

    Every finished fit is kept in `output`/runs as a scene, so that the same call goes on where an earlier one was
    interrupted. Remove the folder to measure changed code anew. No fit's seconds are held against another's, so that
    they may run side by side; the report says where they ran.

    Args:
        output: folder.
        data: folder with bsds in it; None: one photo is all there is.
        quick: two pictures, half as large, and few iterations.
        place: where the fits are made.

    Raises:
        ValueError: there are no pictures in the data.
        RuntimeError: fits failed; the others are kept, and in the report.
    """
    trials = plan(data, quick)
    scenes = Scenes(output.absolute() / "runs", None if data is None else data.absolute())
    try:
        # a picture's baseline before its maps, so that what is there when somebody interrupts can be compared
        failed = _obtain(scenes, [t for trial in trials for t in (trial.baseline(), trial)], place)
        rivals = [scenes.equal_bytes(trial) for trial in trials if scenes.has(trial)]
        failed += _obtain(scenes, [rival for rival in rivals if rival is not None], place)
    finally:
        results = [result for trial in trials if (result := scenes.result(trial)) is not None]
        values = ([*result, *(getattr(result, name) for name in _GAINS)] for result in results)
        write_csv(output / "results.csv", [*Result._fields, *_GAINS], values)
        write(output, results, planned=len(trials), quick=quick, place=place)
    check_made(failed)
    from rich.console import Console

    Console().print(f"{output}/report.md")


def _obtain(scenes: Scenes, trials: list[Trial], place: Place) -> list[str]:
    missing = [trial for trial in dict.fromkeys(trials) if not scenes.has(trial)]
    return make_all(scenes.make, missing, place, name=lambda t: f"{t.image}, N = {t.n:,}, map: {t.source}")
