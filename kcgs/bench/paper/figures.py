"""Figures of the paper's experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcgs.bench.plots import COLORS, figure, save_figure
from kcgs.functional import edge_band

from .compare import QUANTITIES, by_picture, mean, select, shared
from .trials import Row

_MARKERS = ("o", "s", "^", "D", "v", "P")
_AXES = {"psnr": "PSNR (dB)", "ms_ssim": "MS-SSIM", "ef_psnr": "EF-PSNR (dB)", "ef_ssim": "edge SSIM"}
_LARGEST_ERROR = 0.3


def plot_against_n(path: Path, rows: Sequence[Row], methods: Sequence[str]) -> None:
    """Draw the four figures against N: means over the pictures that all methods have at that N."""
    plot, axes = figure(2, 2, width=9.0, height=6.8)
    for axis, quantity in zip(axes.flat, QUANTITIES, strict=True):
        for index, name in enumerate(methods):
            points = _means(rows, methods, name, quantity, "n")
            axis.plot(*_columns(points), color=COLORS[index], marker=_MARKERS[index], markersize=4.5, label=name)
        axis.set(xlabel="number of Gaussians N", ylabel=_AXES[quantity], xscale="log")
        ticks = sorted({row.n for name in methods for row in select(rows, name)})
        axis.set_xticks(ticks, [f"{n:,}" for n in ticks], fontsize=8, rotation=30)
        axis.minorticks_off()
    _legend_below(plot, axes.flat[0])
    save_figure(plot, path)


def plot_against_bits(path: Path, rows: Sequence[Row], methods: Sequence[str]) -> None:
    """Draw PSNR and EF-PSNR of the decoded files against their bits per pixel."""
    from matplotlib.ticker import LogLocator

    plot, axes = figure(1, 2, width=9.0, height=4.2)
    for axis, quantity in zip(axes, ("decoded_psnr", "decoded_ef_psnr"), strict=True):
        for index, name in enumerate(methods):
            points = _means(rows, methods, name, quantity, "bits_per_pixel")
            axis.plot(*_columns(points), color=COLORS[index], marker=_MARKERS[index], markersize=4.5, label=name)
        axis.set(xlabel="bits per pixel of the .kcgs file", xscale="log")
        axis.set_ylabel(_AXES[quantity.removeprefix("decoded_")] + ", decoded")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("")
    _legend_below(plot, axes[0])
    save_figure(plot, path)


def plot_strip(path: Path, lines: Sequence[Mapping[str, Tensor]], *, side_names: Sequence[str] = ()) -> None:
    """Draw pictures, a line each mapping, with their titles above.

    Args:
        path: .png or .jpg.
        lines: pictures (3, H, W) by title; a picture (H, W) is an error, drawn in colours of its own.
        side_names: of the lines.
    """
    height, width = next(iter(lines[0].values())).shape[-2:]
    columns = max(map(len, lines))
    plot, axes = figure(len(lines), columns, width=2.15 * columns, height=(2.15 * height / width + 0.42) * len(lines))
    axes = axes if len(lines) > 1 and columns > 1 else [axes] if len(lines) == 1 else [[axis] for axis in axes]
    for row, line in enumerate(lines):
        for axis, (title, picture) in zip(axes[row], line.items(), strict=False):
            _draw(axis, picture)
            axis.set_title(title, fontsize=7.5)
        if side_names:
            axes[row][0].set_ylabel(side_names[row], fontsize=8)
    for axis in (axis for row in axes for axis in row):
        axis.set(xticks=[], yticks=[])
        axis.grid(False)
    save_figure(plot, path)


def plot_changes(path: Path, changes: Mapping[str, Mapping[str, tuple[float, float]]]) -> None:
    """Draw changes in PSNR and EF-PSNR, a line a row, a panel each title.

    Args:
        path: PNG to write.
        changes: by title and row.
    """
    tallest, columns = max(map(len, changes.values())), min(2, len(changes))
    lines = -(-len(changes) // columns)
    plot, axes = figure(lines, columns, width=5.4 * columns, height=0.5 + lines * (1.1 + 0.28 * tallest))
    panels = np.ravel(axes)
    for axis in panels[len(changes) :]:
        axis.remove()
    for axis, (title, rows) in zip(panels, changes.items(), strict=False):
        at = range(len(rows))[::-1]
        axis.axvline(0.0, color="black", linewidth=0.8)
        axis.plot([psnr for psnr, _ in rows.values()], at, "o", color=COLORS[0], label="PSNR")
        axis.plot([ef for _, ef in rows.values()], at, "s", color=COLORS[1], markersize=4, label="EF-PSNR")
        axis.set_yticks(at, list(rows))
        axis.set_ylim(-0.6, len(rows) - 0.4)
        axis.set(xlabel="change (dB)")
        axis.set_title(title, fontsize=8)
    handles, names = panels[0].get_legend_handles_labels()
    plot.legend(handles, names, loc="outside lower center", ncols=2)
    save_figure(plot, path)


def error(picture: Tensor, image: Tensor) -> Tensor:
    """Return the root of the mean squared error of every pixel, (H, W)."""
    return (picture - image).square().mean(0).sqrt()


def window(labels: Tensor, height: int, width: int) -> tuple[slice, slice]:
    """Find the part of a picture with the most contour in it."""
    band = edge_band(labels).float()[None, None]
    height, width = min(height, labels.shape[0]), min(width, labels.shape[1])
    stride = max(1, min(height, width) // 8)
    density = torch.nn.functional.avg_pool2d(band, (height, width), stride)[0, 0]
    row, column = divmod(int(density.argmax()), density.shape[1])
    y, x = row * stride, column * stride
    return slice(y, y + height), slice(x, x + width)


def _draw(axis: Any, picture: Tensor) -> None:
    if picture.ndim == 2:
        axis.imshow(picture.numpy(), cmap="magma", vmin=0.0, vmax=_LARGEST_ERROR)
    else:
        axis.imshow(picture.permute(1, 2, 0).numpy(), interpolation="nearest")


def _means(
    rows: Sequence[Row], methods: Sequence[str], name: str, quantity: str, across: str
) -> list[tuple[float, float]]:
    swept, images = sweep(rows, methods)
    points = []
    for n in swept:
        found = [row for row in select(rows, name, n) if row.picture in images]
        y = mean(by_picture(found, quantity).values())
        if y == y:
            points.append((mean(by_picture(found, across).values()), y))
    return points


def sweep(rows: Sequence[Row], methods: Sequence[str]) -> tuple[list[int], list[str]]:
    """Return the N that are drawn, and the pictures that all methods have at all of them.

    An N that fewer than half of the pictures have, or a single method, is left out: a line must not go from the mean
    over some pictures to the mean over others.
    """
    found = {n: images for n, present, images in shared(rows, methods) if len(present) > 1}
    most = max(map(len, found.values()), default=0)
    swept = {n: set(images) for n, images in found.items() if 2 * len(images) > most}
    everywhere = set.intersection(*swept.values()) if swept else set()
    return sorted(swept), sorted(everywhere)


def _columns(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _legend_below(plot: Any, axis: Any) -> None:
    handles, names = axis.get_legend_handles_labels()
    plot.legend(handles, names, loc="outside lower center", ncols=min(len(names), 5))
