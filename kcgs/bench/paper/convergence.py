"""Quality against seconds for every recipe, and other codecs at the same bytes: `kcgs bench convergence`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kcgs.bench.cells import count, db, markdown, seconds, signed
from kcgs.bench.fits import HERE, check_made
from kcgs.bench.plots import COLORS, figure, save_figure

from . import peers, pictures, tables
from .compare import QUANTITIES, select
from .methods import BASELINE, BEST, CLAMPED, FULL_ITERATIONS, PAPER, REFINED, UNCLAMPED
from .options import PUBLISHED_ITERATIONS, Options
from .peers import Peer
from .report import METRICS_TEXT, head, what_was_run, write
from .tables import Contest
from .trials import Row, Store, Trial, near, plan, rivals

NUM_GAUSSIANS = 1_250
QUICK_GAUSSIANS = 40
QUICK_STRIDE = 4
METHODS = (BEST, REFINED, BASELINE, PAPER, UNCLAMPED, CLAMPED)
NAMES = tuple(m.name for m in METHODS)
# the share of the budget, or the seconds, that the network gets
_NETWORK_SHARE, _NETWORK_SECONDS, _QUICK_NETWORK_SECONDS = 0.2, 60.0, 0.5
_QUALITIES = (20.0, 22.0, 24.0, 25.0, 26.0, 27.0, 28.0)
_SPEED_TEXT = """All fits ran on the same kernel, on one thread. Seconds are those of a processor: the wall
time at which a fit had a quality, times the share of a processor that the whole fit had, so that what else the machine
did is not in them; the start of a fit is, compilation is not. *Never*: the fit ends below. `paper` dips where it reads
the regions' ids anew."""
_PEER_TEXT = """JPEG, WebP and AVIF, also tuned for PSNR (Pillow, best effort): the largest file that is not above
the bytes of the `.kcgs` file of `best`, s that of this one file; SIREN: three hidden layers with sines, weights at
half precision and nothing else counted, the widest that these bytes hold, Adam on random pixels for the seconds
shown. The Gaussian rows are decoded files, that of `best-baseline` with as many Gaussians as make as many bytes, or
up to 6 % more. The peers were given no contours; figures in the band are taken at the same contours."""


def run(output: Path, options: Options) -> None:
    """Fit one picture with every recipe, and store it by other means; write results.csv, report.md and a figure.

    Seconds are compared: fits run one after another whatever the place.

    Args:
        output: folder.
        options: what is asked; of sequences the first is taken, without data a photo of scikit-image, or quick a disc.

    Raises:
        ValueError: a sequence that is not there, numbers out of range.
        RuntimeError: fits failed; the others are kept, and in the report.
    """
    options = options._replace(place=HERE)
    options.check()
    if options.data is None:
        name = "disc" if options.quick else "astronaut"
    else:
        name = pictures.sequences(options.data, options.sequences, quick=False)[0]
    store, wanted, deadline = options.store(output), trials(name, options), options.deadline()
    failed: list[str] = []
    try:
        if options.budget_seconds is not None and deadline is not None:
            deadline -= _NETWORK_SHARE * options.budget_seconds
        failed = store.obtain(wanted, options.place, deadline)
        failed += store.approach(wanted, BEST, BASELINE, options.place, deadline)
    finally:
        _report(output, store, wanted, options)
    check_made(failed)


def trials(name: str, options: Options) -> list[Trial]:
    """List the fits; the quick ones come first."""
    return plan(
        (name,),
        (QUICK_GAUSSIANS if options.quick else NUM_GAUSSIANS,),
        METHODS,
        seeds=options.seeds,
        iterations=options.iterations or (FULL_ITERATIONS if options.budget_seconds is None else PUBLISHED_ITERATIONS),
        stride=QUICK_STRIDE if options.quick else 1,
        quick=options.quick,
    )


def _report(output: Path, store: Store, wanted: list[Trial], options: Options) -> None:
    rows = [in_core_seconds(row) for row in store.rows(wanted)]
    at_our_bytes = store.rows(rivals(store, wanted, BEST, BASELINE))
    others = _peers(store, rows, wanted[0], options)
    parts = head("Error against run time, and other codecs at the same bytes", "convergence", options)
    parts += ["## What was run", what_was_run(rows, wanted, options), METRICS_TEXT]
    if rows:
        n = rows[0].n
        contests = (Contest(BEST.name, BASELINE.name), Contest(REFINED.name, BASELINE.name))
        words = "\n".join(filter(None, [tables.losses([*rows, *at_our_bytes], contests, [n]), beaten(rows, others)]))
        parts += ["## Where ours loses", words]
        _plot(output / "convergence.png", rows, others)
        parts += ["## Error against time", _SPEED_TEXT, "![](convergence.png)"]
        parts += ["### Against the paper's recipe", against_paper(rows)]
        parts += ["### Seconds to a PSNR", reached(rows, "psnr")]
        parts += ["### Seconds to an EF-PSNR", reached(rows, "ef_psnr")]
        parts += [
            "## At the same bytes",
            _PEER_TEXT,
            peer_table([*rows, *at_our_bytes], others),
            peers.GAUSSIAN_TOOLS_TEXT,
        ]
        parts += ["## All figures", tables.BITS_TEXT, tables.rounding(rows), tables.quality(rows, NAMES)]
    write(output, [*rows, *at_our_bytes, *map(_as_row(rows), others)] if rows else rows, parts)


def _peers(store: Store, rows: Sequence[Row], trial: Trial, options: Options) -> list[Peer]:
    found = select(rows, BEST.name)
    if not found:
        return []
    image, labels = pictures.load(trial.picture, store.data, trial.stride)
    size = found[0].bytes
    budget = options.budget_seconds
    length = _NETWORK_SECONDS if budget is None else _NETWORK_SHARE * budget
    length = _QUICK_NETWORK_SECONDS if options.quick else length
    path = store.folder / f"siren-{found[0].scene.removesuffix('.safetensors')}-{size}-{length:g}.json"
    return [*peers.codecs(image, labels, size), peers.ensure_network(path, image, labels, size, length)]


def in_core_seconds(row: Row) -> Row:
    """Return the row with the processor's seconds for wall time, its share of a processor taken as the same always."""
    share = row.core_seconds / row.seconds
    history = tuple(entry._replace(seconds=share * entry.seconds) for entry in row.history)
    return dataclasses.replace(row, history=history)


def seconds_to(row: Row, quantity: str, value: float) -> float:
    """Seconds after which a fit first has this quality; NaN: never."""
    return next((entry.seconds for entry in row.history if getattr(entry, quantity) >= value), math.nan)


def reached(rows: Sequence[Row], quantity: str) -> str:
    """Seconds of every recipe to fixed qualities."""
    top = max(getattr(entry, quantity) for row in rows for entry in row.history)
    levels = [level for level in _QUALITIES if level <= top] or [math.floor(top)]
    lines = []
    for row in rows:
        values = [seconds_to(row, quantity, level) for level in levels]
        cells = ["never" if math.isnan(value) else seconds(value) for value in values]
        lines.append([row.method, count(row.iterations), *cells, seconds(row.core_seconds), db(getattr(row, quantity))])
    return markdown(["recipe", "iterations", *(f"{level:g} dB" for level in levels), "in all", "in the end, dB"], lines)


def against_paper(rows: Sequence[Row]) -> str:
    """How much sooner recipes have the quality that the paper's ends with."""
    found = select(rows, PAPER.name)
    if not found:
        return "The paper's recipe is not there."
    paper = found[0]
    header = ["recipe", "s to its PSNR", "times faster", "s to its EF-PSNR", "times faster"]
    header += ["s in all", "PSNR in the end, more", "EF-PSNR, more"]
    lines = []
    for row in rows:
        if row is not paper:
            cells = []
            for quantity in ("psnr", "ef_psnr"):
                passed = seconds_to(row, quantity, getattr(paper, quantity))
                cells += ["never", ""] if math.isnan(passed) else [seconds(passed), count(paper.core_seconds / passed)]
            cells += [seconds(row.core_seconds), signed(row.psnr - paper.psnr), signed(row.ef_psnr - paper.ef_psnr)]
            lines.append([row.method, *cells])
    text = (
        f"`paper` at {paper.iterations:,} of its {FULL_ITERATIONS:,} iterations took {paper.core_seconds:.0f} s and "
        f"ends at {paper.psnr:.2f} dB, EF-PSNR {paper.ef_psnr:.2f} dB. "
        "Times faster: these seconds through those to the same quality."
    )
    return f"{text}\n\n{markdown(header, lines)}"


def peer_table(rows: Sequence[Row], others: Sequence[Peer]) -> str:
    """Everything at the bytes of our file."""
    header = ["what", "bytes", "bits per pixel", "PSNR", "MS-SSIM", "EF-PSNR", "edge SSIM", "s", "note"]
    pixels, lines = rows[0].pixels, []
    ours = select(rows, BEST.name)[:1]
    for row in [*ours, *filter(None, (near(rows, one, BASELINE.name) for one in ours))]:
        line = [row.method, count(row.bytes), f"{row.bits_per_pixel:.3f}", db(row.decoded_psnr)]
        line += [
            tables.similarity(row.decoded_ms_ssim),
            db(row.decoded_ef_psnr),
            tables.similarity(row.decoded_ef_ssim),
        ]
        lines.append([*line, seconds(row.core_seconds), f"N = {row.n:,}, decoded"])
    for peer in others:
        line = [peer.name, count(peer.bytes), f"{8 * peer.bytes / pixels:.3f}", db(peer.psnr)]
        line += [tables.similarity(peer.ms_ssim), db(peer.ef_psnr), tables.similarity(peer.ef_ssim)]
        lines.append([*line, seconds(peer.seconds), peer.note])
    return markdown(header, lines)


def beaten(rows: Sequence[Row], others: Sequence[Peer]) -> str:
    """Name the peers that are better than our file, by how much, at no more bytes."""
    ours = select(rows, BEST.name)
    if not ours:
        return ""
    lines = []
    for peer in others:
        gaps = {q: getattr(peer, q) - getattr(ours[0], f"decoded_{q}") for q in QUANTITIES}
        ahead = [f"{QUANTITIES[q]} {tables.difference(gap, q)}" for q, gap in gaps.items() if gap > 0]
        if ahead:
            share = f"with {peer.bytes / ours[0].bytes:.2f} of its bytes"
            lines.append(f"- {peer.name} is ahead of `best`, {share}: {', '.join(ahead)}")
    return "\n".join(lines)


def _as_row(rows: Sequence[Row]) -> Any:
    """Return what turns a peer into a line of results.csv: what it stores is what it shows."""

    def turn(peer: Peer) -> Row:
        shown = {key: getattr(peer, key) for key in ("psnr", "ms_ssim", "ef_psnr", "ef_ssim")}
        decoded: dict[str, Any] = {f"decoded_{key}": value for key, value in shown.items()}
        return Row(
            picture=rows[0].picture, n=0, method=peer.name, seed=0, iterations=0, seconds=peer.seconds,
            core_seconds=math.nan, num_gaussians=0, pixels=rows[0].pixels, bytes=peer.bytes, map_bytes=0, scene="",
            **shown, **decoded,
        )  # fmt: skip

    return turn


def _plot(path: Path, rows: Sequence[Row], others: Sequence[Peer]) -> None:
    plot, axes = figure(1, 2, width=9.6, height=4.6)
    for axis, quantity, title in zip(axes, ("psnr", "ef_psnr"), ("PSNR (dB)", "EF-PSNR (dB)"), strict=True):
        for row in rows:
            points = [(entry.seconds, getattr(entry, quantity)) for entry in row.history]
            points = [(x, y) for x, y in points if math.isfinite(y) and x > 0]
            label = f"{row.method}, {row.iterations:,} iterations"
            axis.plot(
                [x for x, _ in points], [y for _, y in points], color=COLORS[NAMES.index(row.method)], label=label
            )
        for peer in others:
            if peer.history:
                values = [entry[1 if quantity == "psnr" else 2] for entry in peer.history]
                label = f"{peer.name} of the bytes of best"
                axis.plot([entry[0] for entry in peer.history], values, "--", color=COLORS[6], label=label)
        axis.set(xlabel="processor seconds", ylabel=title, xscale="log")
        axis.xaxis.set_major_formatter("{x:g}")
    axes[0].set_title(f"{rows[0].picture}, N = {rows[0].n:,}")
    handles, names = axes[0].get_legend_handles_labels()
    plot.legend(handles, names, loc="outside lower center", ncols=3, fontsize=8)
    save_figure(plot, path)
