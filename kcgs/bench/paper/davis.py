"""Quality against the number of Gaussians on first frames of DAVIS: `kcgs bench davis`."""

from __future__ import annotations

from pathlib import Path

from kcgs.bench.fits import check_made
from kcgs.nn.renderer import render_image

from . import figures, pictures, tables
from .compare import equal_n, select
from .methods import BASELINE, BEST, CLAMPED, PAPER, UNCLAMPED
from .options import PUBLISHED_ITERATIONS, Options
from .report import METRICS_TEXT, head, what_was_run, write
from .tables import Contest
from .trials import Row, Store, Trial, plan, rivals

METHODS = (BEST, BASELINE, PAPER, UNCLAMPED, CLAMPED)
NAMES = tuple(m.name for m in METHODS)
# the two that the paper's table has come first
FIRST_COUNTS = (1_250, 7_500)
OTHER_COUNTS = (500, 2_500, 5_000, 10_000)
QUICK_COUNTS = (30, 60)
QUICK_STRIDE = 3
CONTESTS = (
    Contest(BEST.name, BASELINE.name),
    Contest(BEST.name, PAPER.name),
    Contest(BEST.name, UNCLAMPED.name),
    Contest(PAPER.name, UNCLAMPED.name),
    Contest(PAPER.name, CLAMPED.name),
    Contest(BASELINE.name, UNCLAMPED.name),
)
_WORST = 3
_EXTRA_TEXT = """For `best-baseline` files are made until one has as many bytes as that of `best`, or up to 6 % more, so
that the curve has a point there; the other curves have their points at the N above only, a coarse interpolation."""


def run(output: Path, options: Options) -> None:
    """Sweep N on first frames; write results.csv, report.md and figures.

    Every finished fit is kept, so that the same call goes on where an earlier one was interrupted.

    Args:
        output: folder.
        options: what is asked; with a budget, all methods of a sequence are run at the paper's two N before the next.

    Raises:
        ValueError: no data, a sequence that is not there, numbers out of range.
        RuntimeError: fits failed; the others are kept, and in the report.
    """
    options.check()
    names = pictures.sequences(options.data, options.sequences, quick=options.quick)
    store, deadline = options.store(output), options.deadline()
    stages = _stages(names, options)
    failed: list[str] = []
    try:
        for stage in stages:
            failed += store.obtain(stage, options.place, deadline)
            failed += store.approach(stage, BEST, BASELINE, options.place, deadline)
    finally:
        wanted = [trial for stage in stages for trial in stage]
        _report(output, store, wanted, options)
    check_made(failed)


def _stages(names: list[str], options: Options) -> list[list[Trial]]:
    first, rest = (QUICK_COUNTS, ()) if options.quick else (FIRST_COUNTS, OTHER_COUNTS)
    parts: list[tuple[tuple[int, ...], list[str]]] = [(first, names)]
    if options.budget_seconds is not None:
        parts = [(first, [name]) for name in names]
    parts += [((n,), names) for n in rest]
    stride = QUICK_STRIDE if options.quick else 1
    iterations = options.iterations or PUBLISHED_ITERATIONS
    return [
        plan(some, counts, METHODS, seeds=options.seeds, iterations=iterations, stride=stride, quick=options.quick)
        for counts, some in parts
    ]


def _report(output: Path, store: Store, wanted: list[Trial], options: Options) -> None:
    rows = store.rows(wanted)
    extra = store.rows(rivals(store, wanted, BEST, BASELINE))
    both = [*rows, *extra]
    parts = head("DAVIS first frames: quality against the number of Gaussians", "davis", options)
    parts += ["## What was run", what_was_run(rows, wanted, options), METRICS_TEXT]
    if rows:
        at = sorted({row.n for row in rows})
        parts += ["## Where a method loses", tables.losses(both, CONTESTS, at)]
        parts += ["## Do contours pay for their bits?", tables.unpaid(both, BEST.name, BASELINE.name)]
        parts += ["## Differences", tables.EQUAL_BITS_TEXT, _EXTRA_TEXT, tables.differences(both, CONTESTS, at)]
        parts += ["## Means", tables.BITS_TEXT, tables.rounding(rows), tables.quality(rows, NAMES)]
        parts += _figures(output, rows)
        parts += _worst(output, store, rows, options)
        parts += ["## Each sequence", tables.each(rows, NAMES)]
    write(output, both, parts)


def _figures(output: Path, rows: list[Row]) -> list[str]:
    figures.plot_against_n(output / "against-n.png", rows, NAMES)
    figures.plot_against_bits(output / "against-bits.png", rows, NAMES)
    swept, names = figures.sweep(rows, NAMES)
    text = f"Means over the sequences that all methods have at all N that are drawn: {', '.join(names)}."
    left_out = [f"{n:,}" for n in sorted({row.n for row in rows} - set(swept))]
    if left_out:
        text += f" At N = {' and '.join(left_out)} there are too few."
    return [
        "## Against N", text, "![](against-n.png)",
        "## Against bits", "The same sequences and N.", "![](against-bits.png)",
    ]  # fmt: skip


def _worst(output: Path, store: Store, rows: list[Row], options: Options) -> list[str]:
    """Show the sequences on which ours is least better than the improved baseline."""
    n = min(row.n for row in rows) if options.quick else FIRST_COUNTS[0]
    found = equal_n(rows, BEST.name, BASELINE.name, n, "psnr")
    if found is None:
        return []
    lines, names = [], found.worst[:_WORST]
    for name in names:
        picture = pictures.load(name, store.data, QUICK_STRIDE if options.quick else 1)
        part = figures.window(picture.labels, picture.labels.shape[0] // 2, picture.labels.shape[1] // 2)
        image = picture.image[:, *part]
        line = {"original": image}
        for method in (BASELINE.name, BEST.name):
            row = next(row for row in select(rows, method, n) if row.picture == name)
            scene = store.scene(row)
            drawn = render_image(scene.field, scene.regions)[:, *part]
            line[f"{method}\nPSNR {row.psnr:.2f}, EF {row.ef_psnr:.2f}"] = drawn
            line[f"{method}, error"] = figures.error(drawn, image)
        lines.append(line)
    figures.plot_strip(output / "worst.jpg", lines, side_names=names)
    which = ", ".join(f"{name} {found.values[name]:+.2f} dB" for name in names)
    text = f"Least PSNR of `best` over `best-baseline` at N = {n:,}: {which}. Errors are black at 0 and white at 0.3; "
    return ["## The worst sequences", text + "of each picture the part with most contour is shown.", "![](worst.jpg)"]
