"""Figures that look alike: colours that people with any colour vision tell apart."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

# of Okabe and Ito
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")


def figure(rows: int, cols: int, *, width: float, height: float) -> tuple[Any, Any]:
    """Make a figure of `rows` x `cols` axes, sizes in inches; no window is ever opened."""
    from cycler import cycler
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Plot(Figure):
        """A figure that a notebook shows, which knows of none but pyplot's."""

        def _repr_png_(self) -> bytes:
            self.savefig(file := io.BytesIO(), dpi=100)
            return file.getvalue()

    with rc_context({"axes.prop_cycle": cycler(color=COLORS), "axes.grid": True, "grid.alpha": 0.3, "font.size": 9}):
        plot = Plot(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(plot)
        axes = plot.subplots(rows, cols, squeeze=rows == 1)
    return plot, axes


def history_figure(histories: Mapping[str, Sequence[Any]]) -> Any:
    """Plot PSNR and EF-PSNR of fits, by name, against seconds and against iterations."""
    plot, axes = figure(1, 2, width=9.5, height=3.8)
    for axis, field, unit in ((axes[0], "seconds", "seconds"), (axes[1], "iteration", "iterations")):
        for index, (name, history) in enumerate(histories.items()):
            x = [getattr(entry, field) for entry in history]
            axis.plot(x, [entry.psnr for entry in history], color=COLORS[index], label=f"{name}, PSNR")
            edge = [entry.ef_psnr for entry in history]
            if any(value == value for value in edge):
                axis.plot(x, edge, "--", color=COLORS[index], label=f"{name}, EF-PSNR (contours)")
        axis.set(xlabel=unit, ylabel="dB")
        axis.legend(loc="lower right")
    axes[0].set_title("error against run time")
    axes[1].set_title("error against iterations")
    return plot
