"""Quality against seconds for every recipe, and other codecs at the same bytes: `python -m benchmarks convergence`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from kcgs.evaluation import measure
from kcgs.plots import COLORS, figure, save_figure

from . import _siren
from ._codecs import largest, open_file, present
from .core import eye, summaries
from .core.cases import BASELINE, BEST, CLAMPED, PAPER, PUBLISHED_ITERATIONS, REFINED, UNCLAMPED, Case, plan
from .core.compare import QUANTITIES, Contest, select
from .core.figures import add_legend
from .core.images import sequences
from .core.options import Options
from .core.registry import experiment
from .core.report import Made
from .core.rows import read_rows, write_rows
from .core.stages import run_stages
from .core.store import Row, Store
from .core.tables import count, markdown, seconds, signed

NUM_GAUSSIANS, QUICK_GAUSSIANS = 1_250, 40
QUICK_STRIDE = 4
METHODS = (BEST, REFINED, BASELINE, PAPER, UNCLAMPED, CLAMPED)
CONTESTS = (Contest(BEST.name, BASELINE.name), Contest(REFINED.name, BASELINE.name))
SIREN = "SIREN"
# the share of the budget, or the seconds, that the network gets
_NETWORK_SHARE, _NETWORK_SECONDS, _QUICK_NETWORK_SECONDS = 0.2, 60.0, 0.5


class Step(NamedTuple):
    """How good a fit, or the network, was after some processor seconds."""

    method: str
    seconds: float
    psnr: float
    ef_psnr: float


def report(output: Path, made: Made) -> list[str]:
    """Write the report's parts."""
    rows, steps = read_rows(output / "results.csv", Row), read_rows(output / "steps.csv", Step)
    asked = [row for row in rows if row.n == (QUICK_GAUSSIANS if made.quick else NUM_GAUSSIANS)]
    parts = ["# Error against run time, and other codecs at the same bytes", summaries.what_was_run(asked)]
    if not asked:
        return parts
    gaussians, peers = ([row for row in rows if bool(row.n) == is_ours] for is_ours in (True, False))
    lost = [summaries.losses(gaussians, CONTESTS, [asked[0].n]), beaten(asked, peers)]
    parts += ["## Where ours loses", "\n".join(filter(None, lost))]
    parts += ["## Error against time", against_paper(asked, steps), "![](convergence.png)"]
    return [*parts, "## At the same bytes", summaries.means(rows, list(dict.fromkeys(row.method for row in rows)))]


@experiment("sequences", "budget_seconds", "iterations", "runs", report=report)
def run(output: Path, options: Options) -> None:
    """Fit one image with every recipe, and store it by other means.

    Of sequences the first is taken, without data a photo of scikit-image, or in the quick form a disc.
    """
    name = "disc" if options.quick else "astronaut"
    if options.data is not None:
        name = sequences(options.data, options.sequences, quick=False)[0]
    budget, n = options.budget_seconds, QUICK_GAUSSIANS if options.quick else NUM_GAUSSIANS
    iterations = PAPER.config().usual_iterations if budget is None else PUBLISHED_ITERATIONS
    length = _NETWORK_SECONDS if budget is None else _NETWORK_SHARE * budget
    length = _QUICK_NETWORK_SECONDS if options.quick else length

    stages = [plan([name], [n], METHODS, options, iterations, QUICK_STRIDE)]
    share, finish = 1 - _NETWORK_SHARE, partial(_finish, length=length)
    run_stages("convergence", report, output, options, stages, matched=(BASELINE,), finish=finish, share=share)


def _finish(output: Path, store: Store, wanted: Sequence[Case], length: float) -> list[Row]:
    """Make the peers of the file of `best`; write and plot how good everything was when."""
    kept = [found for case in wanted if (found := store.kept(case)) is not None]
    steps = [step for one in kept for step in in_core_seconds(one.row, one.history)]
    peers = []
    best = next((one.row for one in kept if one.row.method == BEST.name), None)
    if best is not None:
        image, labels = wanted[0].load(store.data)
        assert labels is not None
        peers = [codec(name, best, image, labels) for name in present()]
        path = store.folder / f"siren-{best.image}-{best.bytes}-{length:g}.csv"
        network, learned = read_rows(path, Row), read_rows(path.with_suffix(".steps.csv"), Step)
        if not network:
            network, learned = _network(best, image, labels, length)
            write_rows(path, Row, network)
            write_rows(path.with_suffix(".steps.csv"), Step, learned)
        peers, steps = [*peers, *network], [*steps, *learned]
    write_rows(output / "steps.csv", Step, steps)
    _plot(output / "convergence.png", [one.row for one in kept], steps)
    return peers


def in_core_seconds(row: Row, history: Sequence[Any]) -> list[Step]:
    """Put a fit's history in the processor's seconds, its share of a processor taken as the same always."""
    share = row.core_seconds / row.seconds
    return [Step(row.method, share * entry.seconds, entry.psnr, entry.ef_psnr) for entry in history]


def codec(name: str, ours: Row, image: Tensor, labels: Tensor) -> Row:
    """Encode with one codec; where even its smallest file is larger than ours, that one, and a note says so."""
    coded = largest(name, image, ours.bytes)
    note = "its smallest file is larger" if len(coded.data) > ours.bytes else ""
    fields = {"bytes": len(coded.data), "seconds": coded.seconds, "note": note}
    return _peer(ours, name, open_file(coded.data), image, labels, fields)


def _network(ours: Row, image: Tensor, labels: Tensor, length: float) -> tuple[list[Row], list[Step]]:
    """Train a SIREN whose half-precision weights fit into as many bytes as ours."""
    trained = _siren.train(image, ours.bytes, seconds=length)
    note = f"{trained.width} wide, {trained.iterations:,} iterations"
    fields = {"bytes": trained.bytes, "seconds": trained.seconds, "note": note}
    row = _peer(ours, SIREN, trained.render, image, labels, fields)
    learned = [(spent, measure(render, image, labels)) for spent, render in trained.history]
    return [row], [Step(SIREN, spent, figures["psnr"], figures["ef_psnr"]) for spent, figures in learned]


def _peer(ours: Row, name: str, render: Tensor, image: Tensor, labels: Tensor, fields: dict[str, Any]) -> Row:
    """Measure another codec's file: what it stores is what it shows."""
    for key, value in measure(render, image, labels).items():
        fields |= {key: value, f"decoded_{key}": value} if key in QUANTITIES else {}
    none = ours._replace(n=0, method=name, seed=0, iterations=0, core_seconds=math.nan, num_gaussians=0, map_bytes=0)
    fields |= dict.fromkeys(eye.MEASURES, math.nan)
    return eye.look(none._replace(**fields), lambda: (render, image))


def seconds_to(steps: Sequence[Step], method: str, quantity: str, value: float) -> float:
    """Seconds after which a fit first has this quality; NaN: never."""
    found = (step.seconds for step in steps if step.method == method and getattr(step, quantity) >= value)
    return next(found, math.nan)


def against_paper(rows: Sequence[Row], steps: Sequence[Step]) -> str:
    """How much sooner recipes have the quality that the paper's ends with."""
    found = select(rows, PAPER.name)
    if not found:
        return "The paper's recipe is not there."
    paper = found[0]
    header = ["recipe", "s to its PSNR", "times faster", "s to its EF-PSNR", "times faster"]
    header += ["s in all", "PSNR in the end, more", "EF-PSNR, more"]
    lines = []
    for row in rows:
        cells = []
        for quantity in ("psnr", "ef_psnr"):
            passed = seconds_to(steps, row.method, quantity, getattr(paper, quantity))
            cells += ["never", ""] if math.isnan(passed) else [seconds(passed), count(paper.core_seconds / passed)]
        cells += [seconds(row.core_seconds), signed(row.psnr - paper.psnr), signed(row.ef_psnr - paper.ef_psnr)]
        lines += [] if row is paper else [[row.method, *cells]]
    text = (
        f"`paper` at {paper.iterations:,} of its {PAPER.config().usual_iterations:,} iterations took "
        f"{paper.core_seconds:.0f} s and ends at {paper.psnr:.2f} dB, EF-PSNR {paper.ef_psnr:.2f} dB. "
        "Times faster: these seconds through those to the same quality."
    )
    return f"{text}\n\n{markdown(header, lines)}"


def beaten(rows: Sequence[Row], peers: Sequence[Row]) -> str:
    """Name the peers that are better than our file, by how much, at no more bytes."""
    lines = []
    for ours in select(rows, BEST.name)[:1]:
        for peer in peers:
            gaps = {q: getattr(peer, q) - getattr(ours, f"decoded_{q}") for q in QUANTITIES}
            ahead = [f"{QUANTITIES[q]} {summaries.difference(gap, q)}" for q, gap in gaps.items() if gap > 0]
            if ahead:
                share = f"with {peer.bytes / ours.bytes:.2f} of its bytes"
                lines.append(f"- {peer.method} is ahead of `best`, {share}: {', '.join(ahead)}")
    return "\n".join(lines)


def _plot(path: Path, rows: Sequence[Row], steps: Sequence[Step]) -> None:
    plot, axes = figure(1, 2, width=9.6, height=4.6)
    labels = {row.method: f"{row.method}, {row.iterations:,} iterations" for row in rows}
    colors = {**{m.name: COLORS[index] for index, m in enumerate(METHODS)}, SIREN: COLORS[6]}
    for axis, quantity, title in zip(axes, ("psnr", "ef_psnr"), ("PSNR (dB)", "EF-PSNR (dB)"), strict=True):
        for name in dict.fromkeys(step.method for step in steps):
            points = [(step.seconds, getattr(step, quantity)) for step in steps if step.method == name]
            points = [(x, y) for x, y in points if math.isfinite(y) and x > 0]
            label, line = labels.get(name, f"{name} of the bytes of best"), "--" if name == SIREN else "-"
            axis.plot([x for x, _ in points], [y for _, y in points], line, color=colors[name], label=label)
        axis.set(xlabel="processor seconds", ylabel=title, xscale="log")
        axis.xaxis.set_major_formatter("{x:g}")
    axes[0].set_title(f"{rows[0].image}, N = {rows[0].n:,}")
    add_legend(plot, axes[0], columns=3)
    save_figure(plot, path)
