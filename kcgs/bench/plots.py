"""Figures drawn alike: colour-blind safe, labelled, written whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kcgs._atomic import atomic_path

# Okabe and Ito's colours, which people with any colour vision tell apart
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")


def figure(rows: int, cols: int, *, width: float, height: float) -> tuple[Any, Any]:
    """Make a figure of `rows` x `cols` axes, sizes in inches; no window is ever opened."""
    from cycler import cycler
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context({"axes.prop_cycle": cycler(color=COLORS), "axes.grid": True, "grid.alpha": 0.3, "font.size": 9}):
        plot = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(plot)
        axes = plot.subplots(rows, cols, squeeze=rows == 1)
    return plot, axes


def save_figure(plot: Any, path: Path) -> None:
    """Write the figure."""
    with atomic_path(path) as temporary:
        plot.savefig(temporary, dpi=130)
