"""Quality against the number of Gaussians on first frames of DAVIS: `kcgs bench davis`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .core import figures, summaries
from .core.cases import BASELINE, BEST, CLAMPED, IMAGE_GS, PAPER, PUBLISHED_ITERATIONS, UNCLAMPED, Case, plan
from .core.compare import Contest, equal_n, sweep
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
_WORST = 3
_EXTRA_TEXT = """For `best-baseline` files are made until one has as many bytes as that of `best`, or up to 6 % more, so
that the curve has a point there; the other curves have their points at the N above only, a coarse interpolation."""


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    rows = read_rows(output / "results.csv", Row)
    asked = [row for row in rows if row.n in _counts(made.quick)]
    parts = ["# DAVIS first frames: quality against the number of Gaussians", "## What was run"]
    parts += [summaries.what_was_run(asked, METHODS), summaries.METRICS_TEXT]
    if not asked:
        return parts
    counts = sorted({row.n for row in asked})
    parts += ["## Where a method loses", summaries.losses(rows, CONTESTS, counts)]
    parts += ["## Do contours pay for their bits?", summaries.unpaid(rows, BEST.name, BASELINE.name)]
    parts += ["## Differences", summaries.EQUAL_BITS_TEXT, _EXTRA_TEXT]
    parts += [summaries.differences(rows, CONTESTS, counts)]
    parts += ["## Means", summaries.BITS_TEXT, summaries.rounding(asked), summaries.quality(asked, NAMES)]
    parts += _figures(output, asked)
    parts += _worst_text(output, asked, _counts(made.quick)[0])
    return [*parts, "## Each sequence", summaries.each(asked, NAMES)]


@experiment("engine", "workers", "sequences", "budget_seconds", "seeds", "iterations", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Sweep N on first frames; with a budget, a sequence has all methods at the paper's two N before the next."""
    names = sequences(options.data, options.sequences, quick=options.quick)
    run_stages("davis", report, output, options, _stages(names, options), matched=(BASELINE,), finish=_show_worst)


def _counts(quick: bool) -> tuple[int, ...]:
    return QUICK_COUNTS if quick else FIRST_COUNTS + OTHER_COUNTS


def _stages(names: list[str], options: Options) -> list[list[Case]]:
    first, rest = (QUICK_COUNTS, ()) if options.quick else (FIRST_COUNTS, OTHER_COUNTS)
    parts: list[tuple[tuple[int, ...], list[str]]] = [(first, names)]
    if options.budget_seconds is not None:
        parts = [(first, [name]) for name in names]
    parts += [((n,), names) for n in rest]
    return [plan(part, counts, METHODS, options, PUBLISHED_ITERATIONS, QUICK_STRIDE) for counts, part in parts]


def _figures(output: Path, rows: list[Row]) -> list[str]:
    figures.plot_against_n(output / "against-n.png", rows, NAMES)
    figures.plot_against_bits(output / "against-bits.png", rows, NAMES)
    swept, names = sweep(rows, NAMES)
    text = f"Means over the sequences that all methods have at all N that are shown: {', '.join(names)}."
    left_out = [f"{n:,}" for n in sorted({row.n for row in rows} - set(swept))]
    if left_out:
        text += f" At N = {' and '.join(left_out)} there are too few."
    parts = ["## Against N", text, "![](against-n.png)"]
    return [*parts, "## Against bits", "The same sequences and N.", "![](against-bits.png)"]


def _worst_text(output: Path, rows: list[Row], n: int) -> list[str]:
    found = equal_n(rows, BEST.name, BASELINE.name, n, "psnr")
    if found is None or not (output / "worst.jpg").is_file():
        return []
    which = ", ".join(f"{name} {found.values[name]:+.2f} dB" for name in found.worst[:_WORST])
    text = f"Least PSNR of `best` over `best-baseline` at N = {n:,}: {which}. Errors are black at 0 and white at 0.3; "
    return ["## The worst sequences", text + "of each image the part with most contour is shown.", "![](worst.jpg)"]


def _show_worst(output: Path, store: Store, wanted: Sequence[Case]) -> list[Row]:
    """Show the sequences on which ours is least better than the improved baseline."""
    n = wanted[0].n
    found = equal_n(store.rows(wanted), BEST.name, BASELINE.name, n, "psnr")
    lines, names = [], [] if found is None else found.worst[:_WORST]
    for name in names:
        pair = {case.method: case for case in reversed(wanted) if (case.image, case.n) == (name, n)}
        image, labels = pair[BEST].load(store.data)
        assert labels is not None
        part = figures.window(labels, labels.shape[0] // 2, labels.shape[1] // 2)
        line = {"original": image[:, *part]}
        for method in (BASELINE, BEST):
            row, shown = store.row(pair[method]), store.scene(pair[method]).render()
            assert row is not None
            line[f"{method.name}\nPSNR {row.psnr:.2f}, EF {row.ef_psnr:.2f}"] = shown[:, *part]
            error = (shown - image).square().mean(0).sqrt()
            line[f"{method.name}, error"] = error[part]
        lines.append(line)
    if lines:
        figures.plot_images(output / "worst.jpg", lines, side_names=names)
    return []
