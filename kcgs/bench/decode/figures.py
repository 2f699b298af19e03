"""The figures of the report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from kcgs.bench.plots import COLORS, figure, save_figure

from .decoders import DECODERS
from .findings import Findings, cutoff_name

_MARKERS = "os^D"


def plot_sweep(found: Findings, path: Path) -> None:
    """Draw the largest error against milliseconds, a panel for each scene, a line for each decoder."""
    scenes, cutoffs = found.names("error", "scene"), found.names("error", "cutoff")
    cols = min(2, len(scenes))
    rows = math.ceil(len(scenes) / cols)
    plot, axes = figure(rows, cols, width=9.5, height=0.4 + 3.4 * rows)
    panels = list(axes.flat) if rows * cols > 1 else [axes]
    for axis, scene in zip(panels, scenes, strict=False):
        for name in found.names("error", "decoder"):
            points = [
                [found.value("error", scene, "native", name, q, cutoff=c) for q in ("time", "max error")]
                for c in cutoffs
            ]
            axis.plot(*zip(*points, strict=True), "-", **_style(name))
            for cutoff, point in zip(cutoffs, points, strict=True):
                offset = {"textcoords": "offset points", "xytext": (4, 4), "fontsize": 7}
                axis.annotate(cutoff_name(cutoff), point, **offset)
        axis.set(xlabel="milliseconds, one thread", ylabel="max error", xscale="log", yscale="log")
        _plain_ticks(axis)
        axis.set_title(f"{scene}; points: cutoff")
    for axis in panels[len(scenes) :]:
        axis.set_axis_off()
    plot.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(DECODERS))
    save_figure(plot, path)


def plot_speed(found: Findings, path: Path) -> None:
    """Draw milliseconds by scene and decoder, native and enlarged; filled marks are one thread, hollow ones two."""
    scenes, sizes = found.names("speed", "scene"), found.names("speed", "size")
    plot, axes = figure(1, len(sizes), width=9.5, height=1.6 + 0.3 * len(scenes))
    for axis, size in zip(axes, sizes, strict=True):
        for name in found.names("speed", "decoder"):
            for threads, fill in ((1, "full"), (2, "none")):
                times = [found.value("speed", scene, size, name, "time", threads=threads) for scene in scenes]
                seen = [(value, at) for at, value in enumerate(times) if value is not None]
                more = {} if threads == 1 else {"label": None}
                axis.plot(*zip(*seen, strict=True), linestyle="none", fillstyle=fill, **{**_style(name), **more})
        axis.set(xlabel=f"milliseconds, {size}", xscale="log", yticks=range(len(scenes)), yticklabels=scenes)
        _plain_ticks(axis)
        axis.invert_yaxis()
    axes[0].set_title("filled: one thread; hollow: two")
    plot.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(DECODERS))
    save_figure(plot, path)


def _style(decoder: str) -> dict[str, Any]:
    index = DECODERS.index(decoder)
    return {"color": COLORS[index], "marker": _MARKERS[index], "label": decoder}


def _plain_ticks(axis: Any) -> None:
    """Label milliseconds as numbers, at 1, 2 and 5 of each power of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
