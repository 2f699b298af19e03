"""The two colour charts at 20 Gaussians: `kcgs bench charts`."""

from __future__ import annotations

from pathlib import Path

from kcgs.bench.fits import check_made
from kcgs.nn.renderer import render_image

from . import figures, pictures, tables
from .compare import select
from .methods import BASELINE, BEST, CLAMPED, COVERAGE, PAPER, PAPER_CLAMPED, UNCLAMPED
from .options import Options
from .report import METRICS_TEXT, head, what_was_run, write
from .tables import Contest
from .trials import Row, Store, Trial, plan, rivals

NUM_GAUSSIANS = 20
ITERATIONS = 5_000
QUICK_STRIDE = 2
# the paper's four conditions, and ours
METHODS = (CLAMPED, UNCLAMPED, PAPER_CLAMPED, PAPER, BASELINE, BEST)
NAMES = tuple(m.name for m in METHODS)
SHOWN = {
    CLAMPED.name: "gaussian-image-clamp: baseline, clamp",
    UNCLAMPED.name: "gaussian-image: baseline, no clamp",
    PAPER_CLAMPED.name: "paper, clamp: contour, clamp",
    PAPER.name: "paper: contour, no clamp",
    BASELINE.name: "best-baseline: improved baseline",
    BEST.name: "best: ours",
    COVERAGE.name: COVERAGE.name,
}
CONTESTS = (
    Contest(PAPER.name, UNCLAMPED.name),
    Contest(PAPER.name, CLAMPED.name),
    Contest(PAPER.name, PAPER_CLAMPED.name),
    Contest(PAPER_CLAMPED.name, CLAMPED.name),
    Contest(BEST.name, BASELINE.name),
    Contest(BEST.name, CLAMPED.name),
    Contest(BEST.name, PAPER.name),
    Contest(BASELINE.name, CLAMPED.name),
)
_WINDOW = 60
_OTHERS = (BASELINE, CLAMPED)
_BITS_TEXT = """Of both baselines files are made until one has as many bytes as that of `best`, or up to 6 % more. The
other methods have one size."""
_TEXT = """Flat colours, straight edges in the 2x3 chart (200 x 300) and curved, slightly blurred ones in the pie (300
x 300), 20 Gaussians. The maps are exact. A mean over two charts is not a claim about pictures: each chart has its
table. `best, sub-pixel coverage` is given 8 x 8 labels a pixel, the grid that the pie's own edges were sampled on,
which no photo has; its map costs more bytes."""


def run(output: Path, options: Options) -> None:
    """Fit the charts under the paper's four conditions and ours; write results.csv, report.md and the strip.

    Args:
        output: folder.
        options: what is asked.

    Raises:
        ValueError: sequences were named, numbers out of range.
        RuntimeError: fits failed; the others are kept, and in the report.
    """
    options.check()
    if options.sequences is not None:
        raise ValueError(f"sequences are for DAVIS, charts have none; got {options.sequences!r}")
    store, wanted = options._replace(data=None).store(output), trials(options)
    deadline = options.deadline()
    failed: list[str] = []
    try:
        failed = store.obtain(wanted, options.place, deadline)
        for other in _OTHERS:
            failed += store.approach(wanted, BEST, other, options.place, deadline)
    finally:
        _report(output, store, wanted, options)
    check_made(failed)


def trials(options: Options) -> list[Trial]:
    """List the fits."""
    found = plan(
        pictures.CHARTS,
        (NUM_GAUSSIANS,),
        METHODS,
        seeds=options.seeds,
        iterations=options.iterations or ITERATIONS,
        stride=QUICK_STRIDE if options.quick else 1,
        quick=options.quick,
    )
    if not options.quick:
        found += [t._replace(method=COVERAGE) for t in found if t.picture == "pie" and t.method == BEST]
    return found


def _equal_bytes(store: Store, wanted: list[Trial]) -> list[Trial]:
    return [trial for other in _OTHERS for trial in rivals(store, wanted, BEST, other)]


def _report(output: Path, store: Store, wanted: list[Trial], options: Options) -> None:
    rows = store.rows(wanted)
    both = [*rows, *store.rows(_equal_bytes(store, wanted))]
    parts = head("Colour charts at 20 Gaussians", "charts", options)
    parts += [_TEXT, "## What was run", what_was_run(rows, wanted, options), METRICS_TEXT]
    if rows:
        parts += ["## Where a method loses", tables.losses(both, CONTESTS, [NUM_GAUSSIANS])]
        parts += ["## Results", tables.BITS_TEXT, tables.rounding(rows)]
    for name in dict.fromkeys(row.picture for row in rows):
        here = [row for row in rows if row.picture == name]
        present = tuple(n for n in SHOWN if select(here, n))
        parts += [f"### {name}", tables.quality(here, present, SHOWN)]
        if _strip(output / f"strip-{name}.jpg", store, here, options):
            parts.append(f"![](strip-{name}.jpg)")
    if rows:
        parts += ["## Differences", tables.EQUAL_BITS_TEXT, _BITS_TEXT]
        parts.append(tables.differences(both, CONTESTS, [NUM_GAUSSIANS]))
        extra = [row for row in both if row.n != NUM_GAUSSIANS]
        parts.append("" if extra else "No fits of the baselines at our bytes are there.")
        parts += ["### The baselines with the Gaussians that our bytes buy", tables.each(extra, NAMES)] if extra else []
    write(output, both, parts)


def _strip(path: Path, store: Store, rows: list[Row], options: Options) -> bool:
    """Draw what each method draws, and a part of it with contours."""
    name = rows[0].picture
    picture = pictures.load(name, None, QUICK_STRIDE if options.quick else 1)
    part = figures.window(picture.labels, _WINDOW, _WINDOW)
    whole = {"original": picture.image}
    for method in NAMES:
        found = select(rows, method)
        if found:
            scene = store.scene(found[0])
            title = f"{method}\nPSNR {found[0].psnr:.1f}, EF {found[0].ef_psnr:.1f}"
            whole[title] = render_image(scene.field, scene.regions)
    if len(whole) == 1:
        return False
    near = {" " * index: drawn[:, *part] for index, drawn in enumerate(whole.values())}
    figures.plot_strip(path, [whole, near], side_names=("chart", "part"))
    return True
