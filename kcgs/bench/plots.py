"""Transitional: figures are in kcgs.plots."""

from kcgs.plots import COLORS, figure, plot_history, save_figure

__all__ = ["COLORS", "figure", "plot_history", "save_figure"]
