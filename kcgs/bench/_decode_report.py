"""The report of `kcgs bench decode`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

from kcgs.plots import COLORS, figure, save_figure

from ._decoders import DECODERS, GENERIC, SCENE, TRUTH_CUTOFF, YARDSTICK
from .core.readings import Column, Readings
from .core.report import Made
from .core.rows import read_rows
from .core.tables import markdown, number

GOALS = {"W1": 10.0, "W2": 16.0}
_MOST = {"to cpu": 3.0, "load": 500.0, "ratio": 2.5}
_MARKERS = "os^D"

_SCENES_TEXT = """Contours are `none` (one region), `hard`, or `soft`. The workloads' soft contours have a standard
deviation of 0.7 pixels."""
_SPEED_TEXT = """Milliseconds for one image, medians; all decoders of a scene are timed in turns in one process, on
one thread and on two, at the default cutoff of 1e-4. `to cpu` is the median of the ratios to torch's `cpu` kernel on
as many threads in the same round. torch's kernels and the generic decoder are given the Gaussians scaled and the
label map sampled for the size that is rendered, once for all images; the scene decoder does both in every image.
Errors are against float64, colours in [0, 1]; values of the workloads' images go up to about 5, since they are sums
of 12 Gaussians."""
_GOAL_TEXT = """What a scene decoder ought to reach: on one thread at the scene's own size at most 10 ms at N = 1,250
and 16 ms at N = 7,500, at most 3 times the `cpu` kernel's time, loaded in under 500 ms, at most 2.5 times the scene's
bytes. Milliseconds are those of this machine."""
_FILES_TEXT = """`ratio` is the scene decoder's bytes over the scene's. The generic decoder is one file for all scenes
and needs the scene beside it. `export` is the time to make and write both decoders and the scene. Loading goes from
the files on disk to being ready to render, onnxruntime's optimisation of the graph, scaling and sampling the label map
included; the first image is loading and rendering once. One thread, medians."""
_MEMORY_TEXT = """MB added at the peak by loading and rendering one image, on one thread, each in a process of its own
that has rendered a small scene before. At another size that includes sampling the label map, for all but the scene
decoder."""
_SWEEP_TEXT = """One thread, the scene's own size, cutoffs of 1e-2, 1/255, 1e-3, 1e-4 and 1e-6; all timed in turns.
Left and below is better."""
_LEFT_OUT_TEXT = "What each decoder says that it does without."


class Row(NamedTuple):
    """One measured number."""

    section: str
    scene: str
    size: str
    decoder: str
    threads: int
    cutoff: float
    quantity: str
    value: float
    unit: str


class SceneRow(NamedTuple):
    """What a report says of a scene."""

    scene: str
    height: int
    width: int
    num_gaussians: int
    num_regions: int
    contours: str
    source: str


class LeftOut(NamedTuple):
    """A sentence of what a decoder says that it does without."""

    decoder: str
    scene: str
    """Empty: any."""
    sentence: str


def report(folder: Path, made: Made) -> list[str]:
    """Write the figures, and return the parts of the report."""
    rows, scenes = Readings(read_rows(folder / "results.csv", Row)), read_rows(folder / "scenes.csv", SceneRow)
    speed, files, memory = (rows.select(section=name) for name in ("speed", "files", "memory"))
    errors = Readings(row._replace(cutoff=cutoff_name(row.cutoff)) for row in rows.select(section="error"))
    _plot_sweep(errors, folder / "error-against-time.png")
    _plot_speed(speed, folder / "speed.png")
    parts = ["# Decoding: speed, error, memory, bytes", "## Scenes", _SCENES_TEXT, _scene_table(scenes)]
    parts += ["## Speed and error", _SPEED_TEXT, _truth_text(rows.select(section="truth"))]
    parts += ["![](speed.png)", _speed_table(speed)]
    if not made.quick:
        parts += ["## The scene decoder's goals", _GOAL_TEXT, _goal_table(speed, files, scenes)]
    parts += ["## Error against time", _SWEEP_TEXT, "![](error-against-time.png)", _sweep_table(errors)]
    parts += ["## Files and loading", _FILES_TEXT, _bytes_table(files), _loading_table(files)]
    peaks = {name: {"decoder": name} for name in memory.names("decoder")}
    parts += ["## Peak memory", _MEMORY_TEXT, memory.table(["scene", "size"], peaks)]
    return [*parts, "## Left out by the decoders", _LEFT_OUT_TEXT, _left_out_list(folder)]


def cutoff_name(value: float) -> str:
    """Write a cutoff as people do."""
    return "1/255" if math.isclose(value, 1 / 255, rel_tol=1e-3) else f"{value:.0e}".replace("e-0", "e-")


def _scene_table(scenes: list[SceneRow]) -> str:
    header = ["scene", "height x width", "N", "regions", "contours", "made"]
    lines = [
        [s.scene, f"{s.height} x {s.width}", f"{s.num_gaussians:,}", str(s.num_regions), s.contours, s.source]
        for s in scenes
    ]
    return markdown(header, lines)


def _truth_text(rows: Readings) -> str:
    differences = ", ".join(f"{number(row.value)} ({row.scene})" for row in rows)
    return (
        f"The truth is the `tiled` kernel in float64 at a cutoff of {TRUTH_CUTOFF:.0e}. From `reference`, the "
        f"dense sum in float64 at cutoff 0, it differs by at most {differences}."
    )


def _speed_table(rows: Readings) -> str:
    columns = {
        f"{name}{suffix}": {"quantity": quantity, "threads": count}
        for count, suffix in ((1, ""), (2, ", 2 threads"))
        for name, quantity in (("ms", "time"), ("to cpu", "to cpu"))
    }
    errors = {name: {"quantity": name} for name in ("max error", "rms error")}
    return rows.table(["scene", "size", "decoder"], {**columns, **errors})


def _goal_table(speed: Readings, files: Readings, scenes: list[SceneRow]) -> str:
    lines = []
    for scene in scenes:
        mine = {"scene": scene.scene, "size": "native", "decoder": SCENE, "threads": 1}
        values = {"time": speed.value(quantity="time", **mine), "to cpu": speed.value(quantity="to cpu", **mine)}
        values |= {"load": files.value(quantity="load", **mine), "ratio": _ratio(files.select(scene=scene.scene))}
        # a fit has a few Gaussians fewer than it was asked for
        most = {"time": GOALS["W1" if scene.num_gaussians <= 1_250 else "W2"], **_MOST}
        cells = [f"{number(values[q])} ({'met' if values[q] <= most[q] else 'missed'})" for q in most]
        lines.append([scene.scene, *cells])
    return markdown(["scene", "ms", "to cpu", "load, ms", "bytes to scene"], lines)


def _sweep_table(rows: Readings) -> str:
    names = {"ms": "time", "to cpu at that cutoff": "to cpu", "max error": "max error", "rms error": "rms error"}
    return rows.table(
        ["scene", "decoder", "cutoff"], {name: {"quantity": quantity} for name, quantity in names.items()}
    )


def _ratio(files: Readings) -> float:
    return files.value(decoder=SCENE, quantity="size") / files.value(decoder=YARDSTICK, quantity="size")


def _bytes_table(rows: Readings) -> str:
    columns: dict[str, Column] = {
        "scene, bytes": {"decoder": YARDSTICK, "quantity": "size"},
        "scene decoder": {"decoder": SCENE, "quantity": "size"},
        "ratio": _ratio,
        "generic decoder": {"decoder": GENERIC, "quantity": "size"},
        "export, ms": {"quantity": "export"},
    }
    return rows.table(["scene"], columns)


def _loading_table(rows: Readings) -> str:
    quantities = ("load", "first image")
    columns = {f"{q}, ms, {size}": {"quantity": q, "size": size} for size in rows.names("size") for q in quantities}
    return Readings(row for row in rows if row.quantity in quantities).table(["scene", "decoder"], columns)


def _left_out_list(folder: Path) -> str:
    sentences: dict[str, list[str]] = {}
    for row in read_rows(folder / "left-out.csv", LeftOut):
        name = f"{row.decoder}: {row.scene}" if row.scene else row.decoder
        sentences.setdefault(name, [f"- {name}"]).append(f"    - {row.sentence}")
    return "\n".join(line for lines in sentences.values() for line in lines)


def _plot_sweep(rows: Readings, path: Path) -> None:
    """Show the largest error against milliseconds, a panel for each scene, a line for each decoder."""
    scenes = rows.names("scene")
    cols = min(2, len(scenes))
    lines = math.ceil(len(scenes) / cols)
    plot, axes = figure(lines, cols, width=9.5, height=0.4 + 3.4 * lines)
    panels = list(axes.flat) if lines * cols > 1 else [axes]
    for axis, scene in zip(panels, scenes, strict=False):
        for name in rows.names("decoder"):
            line = rows.select(scene=scene, decoder=name)
            x, y = ([row.value for row in line.select(quantity=q)] for q in ("time", "max error"))
            axis.plot(x, y, "-", **_style(name))
            for cutoff, *point in zip(line.names("cutoff"), x, y, strict=True):
                axis.annotate(cutoff, point, textcoords="offset points", xytext=(4, 4), fontsize=7)
        axis.set(xlabel="milliseconds, one thread", ylabel="max error", xscale="log", yscale="log")
        _plain_ticks(axis)
        axis.set_title(f"{scene}; points: cutoff")
    for axis in panels[len(scenes) :]:
        axis.set_axis_off()
    plot.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(DECODERS))
    save_figure(plot, path)


def _plot_speed(rows: Readings, path: Path) -> None:
    """Show milliseconds by scene and decoder, native and enlarged; filled marks are one thread, hollow ones two."""
    scenes, sizes = rows.names("scene"), rows.names("size")
    plot, axes = figure(1, len(sizes), width=9.5, height=1.6 + 0.3 * len(scenes))
    for axis, size in zip(axes, sizes, strict=True):
        for name in rows.names("decoder"):
            for count, fill in ((1, "full"), (2, "none")):
                line = rows.select(size=size, decoder=name, threads=count, quantity="time")
                y = [scenes.index(row.scene) for row in line]
                style = {**_style(name), **({} if count == 1 else {"label": None})}
                axis.plot([row.value for row in line], y, linestyle="none", fillstyle=fill, **style)
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
