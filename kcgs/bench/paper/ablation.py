"""The paper's ablation, and ours below it: `kcgs bench ablation`."""

from __future__ import annotations

from pathlib import Path

from kcgs.bench.cells import count, db, markdown, signed
from kcgs.bench.fits import check_made

from . import figures, pictures, tables
from .compare import by_picture, equal_bits, equal_n, mean, select, shared
from .methods import BASELINE, BEST, CLAMPED, PAPER, UNCLAMPED, method
from .options import PUBLISHED_ITERATIONS, Options
from .report import METRICS_TEXT, head, what_was_run, write
from .tables import Contest
from .trials import Row, Store, Trial, plan

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
    method("best without growth", "best", densify_from=1.0),
    method("best without soft contours", "best", softness=0.0),
    method("best with L1 loss", "best", loss="l1"),
    method("best with contours as given", "best", move_contours=False, merge_regions=False),
    BASELINE,
)
SHOWN = {
    **{m.name: m.name for m in (*PAPER_ROWS, *OUR_ROWS)},
    CLAMPED.name: "baseline clamp (gaussian-image-clamp)",
    UNCLAMPED.name: "baseline no clamp (gaussian-image)",
    PAPER.name: "all three (paper)",
    BASELINE.name: "best without regions (best-baseline)",
}
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
_OUR_TEXT = """Parts of `best` taken away one at a time. Changes are to `best`, paired by picture, below zero where the
part helps; at equal bits the file is held against `best` files of as many bytes, where there are two sizes to
interpolate between."""


def run(output: Path, options: Options) -> None:
    """Fit every row on first frames; write results.csv and report.md.

    Args:
        output: folder.
        options: what is asked; with a budget, all rows of a sequence at 1,250 come before the next sequence.

    Raises:
        ValueError: no data, a sequence that is not there, numbers out of range.
        RuntimeError: fits failed; the others are kept, and in the report.
    """
    options.check()
    names = pictures.sequences(options.data, options.sequences, quick=options.quick)
    store, wanted = options.store(output), trials(names, options)
    failed: list[str] = []
    try:
        failed = store.obtain(wanted, options.place, options.deadline())
    finally:
        _report(output, store, wanted, options)
    check_made(failed)


def trials(names: list[str], options: Options) -> list[Trial]:
    """List the fits, all sequences at the smaller N first."""
    return [
        trial
        for n in (QUICK_COUNTS if options.quick else COUNTS)
        for trial in plan(
            names[:1] if options.quick else names,
            (n,),
            (*OUR_ROWS, *PAPER_ROWS),  # a budget sees those first that are done soonest
            seeds=options.seeds,
            iterations=options.iterations or PUBLISHED_ITERATIONS,
            stride=QUICK_STRIDE if options.quick else 1,
            quick=options.quick,
        )
    ]


def _report(output: Path, store: Store, wanted: list[Trial], options: Options) -> None:
    rows = store.rows(wanted)
    parts = head("Ablation", "ablation", options)
    parts += ["## What was run", what_was_run(rows, wanted, options), METRICS_TEXT]
    if rows:
        contests = [Contest(m.name, CLAMPED.name) for m in PAPER_ROWS[1:]]
        contests += [Contest(BEST.name, m.name) for m in OUR_ROWS[1:]]
        parts += ["## Where a part does harm", tables.losses(rows, contests)]
        parts += _figure(output / "changes.png", rows)
        parts += ["## The paper's rows", _PAPER_TEXT, paper_table(rows)]
        parts += ["## Ours", _OUR_TEXT, our_table(rows)]
        parts += ["## Differences", tables.EQUAL_BITS_TEXT, tables.differences(rows, contests)]
        parts += ["## All figures", tables.BITS_TEXT, tables.rounding(rows), tables.quality(rows, tuple(SHOWN), SHOWN)]
        parts += ["## Each picture", tables.each(rows, tuple(SHOWN))]
    write(output, rows, parts)


def paper_table(rows: list[Row]) -> str:
    """Our means beside the printed ones."""
    header = ["N", "row", "images", "PSNR", "change", "EF-PSNR", "change", "bits per pixel", "decoded PSNR"]
    header += ["theirs: PSNR", "theirs: change", "theirs: EF-PSNR", "theirs: change"]
    lines = []
    for n, present, images in shared(rows, [m.name for m in PAPER_ROWS]):
        for name in present:
            line = [count(n), SHOWN[name], str(len(images))]
            for quantity in ("psnr", "ef_psnr"):
                line.append(db(_mean(rows, name, n, quantity, images)))
                first = _mean(rows, CLAMPED.name, n, quantity, images)
                line.append(signed(_mean(rows, name, n, quantity, images) - first))
            line.append(f"{_mean(rows, name, n, 'bits_per_pixel', images):.3f}")
            line.append(db(_mean(rows, name, n, "decoded_psnr", images)))
            lines.append(line + _printed(name, n))
    return markdown(header, lines)


def our_table(rows: list[Row]) -> str:
    """What each part of ours is worth."""
    header = ["N", "row", "images", "PSNR", "EF-PSNR", "bits per pixel", "decoded PSNR", "PSNR, change", "95 %"]
    header += ["EF-PSNR, change", "95 %", "at equal bits: PSNR, change", "EF-PSNR, change"]
    lines = []
    for n, present, images in shared(rows, [m.name for m in OUR_ROWS]):
        for name in present:
            line = [count(n), SHOWN[name], str(len(images))]
            line += [db(_mean(rows, name, n, q, images)) for q in ("psnr", "ef_psnr")]
            line.append(f"{_mean(rows, name, n, 'bits_per_pixel', images):.3f}")
            line.append(db(_mean(rows, name, n, "decoded_psnr", images)))
            lines.append(line + ([""] * 6 if name == BEST.name else _changes(rows, name, n, images)))
    return markdown(header, lines)


def _figure(path: Path, rows: list[Row]) -> list[str]:
    """Draw the paper's rows against its first, and ours against best."""
    panels: dict[str, dict[str, tuple[float, float]]] = {}
    for first, group, where in ((CLAMPED, PAPER_ROWS, "clamped baseline"), (BEST, OUR_ROWS, "best")):
        for n, present, images in shared(rows, [m.name for m in group]):
            changes = {}
            for name in present if first.name in present and images else []:
                psnr, ef_psnr = (
                    _mean(rows, name, n, q, images) - _mean(rows, first.name, n, q, images) for q in ("psnr", "ef_psnr")
                )
                changes[SHOWN[name]] = psnr, ef_psnr
            changes.pop(SHOWN[first.name], None)
            if changes:
                panels[f"against {where}, N = {n:,}, images: {len(images)}"] = changes
    if not panels:
        return []
    figures.plot_changes(path, panels)
    return ["## Changes", "Means over the images that all rows of a panel have.", "![](changes.png)"]


def _changes(rows: list[Row], name: str, n: int, images: list[str]) -> list[str]:
    here = [row for row in rows if row.picture in images]
    cells = []
    for quantity in ("psnr", "ef_psnr"):
        found = equal_n(here, name, BEST.name, n, quantity)
        spread = "" if found is None or found.low != found.low else f"{signed(found.low)} to {signed(found.high)}"
        cells += ["" if found is None else signed(found.mean), spread]
    for quantity in ("psnr", "ef_psnr"):
        found = equal_bits(here, name, BEST.name, n, quantity)
        cells.append("" if found is None or not found.is_complete else signed(found.mean))
    return cells


def _printed(name: str, n: int) -> list[str]:
    if n not in PRINTED[name]:
        return [""] * 4
    first = PRINTED[CLAMPED.name][n]
    return [
        cell for value, base in zip(PRINTED[name][n], first, strict=True) for cell in (db(value), signed(value - base))
    ]


def _mean(rows: list[Row], name: str, n: int, quantity: str, images: list[str]) -> float:
    found = [row for row in select(rows, name, n) if row.picture in images]
    return mean(by_picture(found, quantity).values())
