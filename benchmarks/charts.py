"""The two colour charts at 20 Gaussians: `python -m benchmarks charts`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .core import figures, images, summaries
from .core.cases import BASELINE, BEST, CLAMPED, PAPER, PAPER_CLAMPED, UNCLAMPED, Case, plan
from .core.compare import Contest
from .core.images import CHARTS
from .core.options import Options
from .core.registry import experiment
from .core.report import Made
from .core.rows import read_rows
from .core.stages import run_stages
from .core.store import Row, Store

NUM_GAUSSIANS = 20
ITERATIONS = 5_000
QUICK_STRIDE = 2
# the paper's four conditions, and ours
METHODS = (CLAMPED, UNCLAMPED, PAPER_CLAMPED, PAPER, BASELINE, BEST)
NAMES = tuple(m.name for m in METHODS)
CONTESTS = (
    *(Contest(PAPER.name, other.name) for other in (UNCLAMPED, CLAMPED, PAPER_CLAMPED)),
    Contest(PAPER_CLAMPED.name, CLAMPED.name),
    *(Contest(BEST.name, other.name) for other in (BASELINE, CLAMPED, PAPER)),
    Contest(BASELINE.name, CLAMPED.name),
)
_OTHERS = (BASELINE, CLAMPED)
_BITS_TEXT = """Of both baselines files are made until one has as many bytes as that of `best`, or up to 6 % more. The
other methods have one size."""
_TEXT = """Flat colours, straight edges in the 2x3 chart (200 x 300) and curved, slightly blurred ones in the pie (300
x 300), 20 Gaussians. The maps are exact. A mean over two charts is not a claim about images: each chart has its
table."""


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    rows = read_rows(output / "results.csv", Row)
    asked = [row for row in rows if row.n == NUM_GAUSSIANS]
    parts = ["# Colour charts at 20 Gaussians", _TEXT, summaries.what_was_run(asked)]
    if not rows:
        return parts
    parts += ["## Where a method loses", summaries.losses(rows, CONTESTS, [NUM_GAUSSIANS])]
    for name in dict.fromkeys(row.image for row in asked):
        parts += [f"## Chart {name}", summaries.means([row for row in rows if row.image == name], NAMES)]
        figure = f"renders-{name}.jpg"
        parts.append(f"![]({figure})" if (output / figure).is_file() else "")
    return [*parts, "## Differences", _BITS_TEXT, summaries.differences(rows, CONTESTS, [NUM_GAUSSIANS])]


@experiment("engine", "workers", "budget_seconds", "seeds", "iterations", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Fit the charts under the paper's four conditions and ours."""
    options = options._replace(data=None)
    run_stages("charts", report, output, options, [cases(options)], matched=_OTHERS, finish=_finish)


def cases(options: Options) -> list[Case]:
    """List the fits."""
    return plan(CHARTS, (NUM_GAUSSIANS,), METHODS, options, ITERATIONS, QUICK_STRIDE)


def _finish(output: Path, store: Store, wanted: Sequence[Case]) -> list[Row]:
    """Show what each method renders."""
    for name in CHARTS:
        shown = {"original": images.load(name, None, wanted[0].stride).image}
        for case in wanted:
            row = store.row(case)
            if row is not None and case.image == name and case.method in METHODS and case.seed == 0:
                shown[f"{row.method}\nPSNR {row.psnr:.1f}, EF {row.ef_psnr:.1f}"] = store.scene(case).render()
        figures.plot_images(output / f"renders-{name}.jpg", shown)
    return []
