"""Figures: means as lines, a panel for each question; images in rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from PIL import Image
from torch import Tensor

from .run import Row
from .tables import group_by, is_missing, title

# the palette of Okabe and Ito; the one of `kcgs.plots` is not public
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
MARKERS = "osD^vP"
# width of a line of the legend, and of the marker of an entry, in characters
_LEGEND_WIDTH = 125
_LEGEND_MARKER = 7


class Panel(NamedTuple):
    """Axes of a figure."""

    title: str
    rows: Sequence[Row]
    x: str
    y: str
    scales: tuple[str, str] = ("log", "linear")


def save_lines(path: Path, panels: Sequence[Panel], line: str, along: str, marker: bool = True) -> None:
    """Plot y over x, a line for each name under `line`, through the means at each value under `along`.

    Rows with an interval, as `compare.differences` gives them, get error bars.
    """
    width, height = min(2, len(panels)), (len(panels) + 1) // 2
    figure = Figure(figsize=(9.5, 0.6 + 3.3 * height), layout="constrained")
    handles: dict[object, Any] = {}
    names = list(dict.fromkeys(row[line] for panel in panels for row in panel.rows))
    with matplotlib.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3}):
        all_axes = np.ravel(figure.subplots(height, width, squeeze=False))
    for panel, axes in zip(panels, all_axes, strict=False):
        rows_with_values = [
            row for row in panel.rows if not (is_missing(row.get(panel.x)) or is_missing(row.get(panel.y)))
        ]
        for (name,), rows in group_by(rows_with_values, [line]).items():
            groups = [group for _, group in sorted(group_by(rows, [along]).items())]
            points = [[fmean(row[quantity] for row in group) for quantity in (panel.x, panel.y)] for group in groups]
            index = names.index(name)
            style = {"marker": MARKERS[index % len(MARKERS)] if marker else None, "markersize": 4}
            x, y = zip(*points, strict=True)
            (handles[name],) = axes.plot(x, y, color=COLORS[index % len(COLORS)], **style)
            bars = [group[0] for group in groups if f"{panel.y} low" in group[0]]
            for bar in bars:
                ends = [bar[f"{panel.y} low"], bar[f"{panel.y} high"]]
                axes.plot([bar[panel.x]] * 2, ends, color=COLORS[index % len(COLORS)], linewidth=1)
        axes.set(xlabel=title(panel.x), ylabel=title(panel.y), title=panel.title)
        axes.set(xscale=panel.scales[0], yscale=panel.scales[1])
        for axis, scale, (low, high) in zip(
            (axes.xaxis, axes.yaxis), panel.scales, (axes.get_xlim(), axes.get_ylim()), strict=True
        ):
            axis.set_major_formatter("{x:g}")
            if scale == "log":
                axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
                axis.set_minor_formatter("{x:g}" if high < 100 * low else "")
    for axes in all_axes[len(panels) :]:
        axes.set_visible(False)
    labels = [str(name) for name in handles]
    columns = _LEGEND_WIDTH // (max(map(len, labels), default=0) + _LEGEND_MARKER)
    figure.legend(handles.values(), labels, loc="outside upper center", ncols=max(1, min(columns, len(labels))))
    figure.savefig(path, dpi=110)


def save_shares(path: Path, parts: Sequence[str], counts: dict[str, list[int]], title: str) -> None:
    """Plot a bar for each name, of its counts of each part, one behind the other."""
    figure = Figure(figsize=(9.5, 1.2 + 0.4 * len(counts)), layout="constrained")
    axes = figure.subplots()
    for index, part in enumerate(parts):
        widths, starts = (
            [sum(values[first:stop]) for values in counts.values()] for first, stop in ((index, index + 1), (0, index))
        )
        axes.barh([*counts], widths, left=starts, color=COLORS[index], label=part)
    axes.invert_yaxis()
    axes.set(xlabel=title)
    figure.legend(loc="outside upper center", ncols=len(parts))
    figure.savefig(path, dpi=110)


def save_rows(path: Path, rows: Sequence[Sequence[Tensor]]) -> None:
    """Write rows of images (3, H, W) of one height each as a sheet."""
    joined = [torch.cat([image.clamp(0, 1) for image in row], 2) for row in rows]
    width = max(row.shape[2] for row in joined)
    sheet = torch.cat([torch.nn.functional.pad(row, (0, width - row.shape[2]), value=1.0) for row in joined], 1)
    Image.fromarray((255 * sheet).round().byte().permute(1, 2, 0).numpy()).save(path, quality=70)


def save_differences(path: Path, rows: Sequence[Row], quantities: Sequence[str], case: str) -> None:
    """Plot differences as points with their intervals, a line for each method, a colour for each case."""
    methods, cases = ([*group_by(rows, [name])] for name in ("method", case))
    figure = Figure(figsize=(9.5, 1.0 + 0.4 * len(methods)), layout="constrained")
    handles: dict[object, Any] = {}
    with matplotlib.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3}):
        all_axes = np.ravel(figure.subplots(1, len(quantities), sharey=True, squeeze=False))
    for axes, quantity in zip(all_axes, quantities, strict=True):
        for row in rows:
            index = cases.index((row[case],))
            style = {"color": COLORS[index % len(COLORS)], "marker": MARKERS[index % len(MARKERS)], "linestyle": ""}
            y = -methods.index((row["method"],)) - 0.15 * index
            ends = [row.get(f"{quantity} {end}", row[quantity]) for end in ("low", "high")]
            axes.plot(ends, [y, y], color=style["color"], linewidth=1)
            (handles[f"{title(case)} = {row[case]:,}"],) = axes.plot(row[quantity], y, markersize=4, **style)
        axes.axvline(0, color="#999999", linewidth=1)
        axes.set(xlabel=f"change of {title(quantity)}", yticks=[-index for index in range(len(methods))])
        axes.set_yticklabels([str(method) for (method,) in methods])
    figure.legend(handles.values(), [str(name) for name in handles], loc="outside upper center", ncols=len(handles))
    figure.savefig(path, dpi=110)
