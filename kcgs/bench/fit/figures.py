"""The experiment's figures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from kcgs.bench.plots import COLORS, figure, save_figure

from .cases import BASELINE, BEST, KEPT, PAPER, PUBLISHED_BASELINE, REFINED
from .compare import Pair, Runs
from .runs import Run

_NAMES = (BASELINE, BEST, KEPT, REFINED, PAPER, PUBLISHED_BASELINE)
_TIMED = ("paper", "astronaut", "charts")


def plot_time(runs: Runs, path: Path) -> str | None:
    """Draw error against seconds of the paper's group, or of what stands in; return the group, None: nothing drawn."""
    group = next((g for g in _TIMED if runs.of(g)), None)
    if group is None:
        return None
    panels = list(dict.fromkeys((r.image, r.n) for r in runs.of(group) if r.n in runs.counts(group)))
    plot, axes = figure(2, len(panels), width=max(5.0, 3.2 * len(panels)), height=6.0)
    for column, (image, n) in enumerate(panels):
        for row, (quantity, label) in enumerate((("psnr", "PSNR (dB)"), ("ef_psnr", "EF-PSNR (dB)"))):
            axis = axes[row, column]
            for name in runs.names(group):
                run = runs.find(group, image, n, name)
                if run is not None:
                    _draw_history(axis, run, quantity)
            axis.set(xlabel="seconds", ylabel=label, xscale="log")
            axis.legend(loc="lower right", fontsize=7)
        axes[0, column].set_title(f"{image}, N = {n:,}")
    save_figure(plot, path)
    return group


def plot_differences(runs: Runs, group: str, path: Path) -> bool:
    """Draw best minus best-baseline for every image, sorted by PSNR; False: there are none."""
    panels = [(n, pairs) for n in runs.counts(group) if (pairs := runs.pairs(group, n, BEST))]
    if not panels:
        return False
    tallest = max(len(pairs) for _, pairs in panels)
    plot, axes = figure(1, len(panels), width=4.8 * len(panels), height=1.4 + 0.22 * tallest)
    for axis, (n, pairs) in zip(axes if len(panels) > 1 else [axes], panels, strict=True):
        _draw_dots(axis, sorted(pairs, key=lambda p: p.psnr))
        axis.set(xlabel="best minus best-baseline (dB)", title=f"{group}, N = {n:,}")
    save_figure(plot, path)
    return True


def _draw_history(axis: Any, run: Run, quantity: str) -> None:
    points = [(entry.seconds, getattr(entry, quantity)) for entry in run.history]
    points = [(x, y) for x, y in points if math.isfinite(y)]
    color = COLORS[_NAMES.index(run.name)] if run.name in _NAMES else COLORS[-1]
    axis.plot([x for x, _ in points], [y for _, y in points], color=color, label=run.name)


def _draw_dots(axis: Any, pairs: list[Pair]) -> None:
    rows = range(len(pairs))
    axis.axvline(0.0, color="black", linewidth=0.8)
    axis.plot([p.psnr for p in pairs], rows, "o", color=COLORS[0], label="PSNR")
    axis.plot([p.ef_psnr for p in pairs], rows, "s", color=COLORS[1], label="EF-PSNR", markersize=4)
    axis.set_yticks(rows, [p.ours.image for p in pairs])
    axis.legend(loc="lower right")
