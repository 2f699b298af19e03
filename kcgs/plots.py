"""The figure of a fit, in colours that people with any colour vision can tell apart."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

# palette of Okabe and Ito
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")


def history_figure(history: Sequence[Any]) -> Any:
    """Plot PSNR and EF-PSNR of a fit against seconds and iterations; no window is opened."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        """A figure that a notebook shows; without this class it would show only figures of pyplot."""

        def _repr_png_(self) -> bytes:
            self.savefig(file := io.BytesIO(), dpi=100)
            return file.getvalue()

    with rc_context({"axes.grid": True, "grid.alpha": 0.3, "font.size": 9}):
        figure = NotebookFigure(figsize=(9.5, 3.8), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(1, 2)
    has_contours = any(entry.ef_psnr == entry.ef_psnr for entry in history)
    for axis, field in zip(axes, ("seconds", "iteration"), strict=True):
        x = [getattr(entry, field) for entry in history]
        axis.plot(x, [entry.psnr for entry in history], color=COLORS[0], label="PSNR")
        if has_contours:
            axis.plot(x, [entry.ef_psnr for entry in history], "--", color=COLORS[0], label="EF-PSNR (contours)")
        axis.set(xlabel=field, ylabel="dB")
        axis.legend(loc="lower right")
    axes[0].set_title("error against run time")
    axes[1].set_title("error against iterations")
    return figure
