"""Figures of fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcgs.functional import edge_band
from kcgs.plots import COLORS, figure, save_figure

from .compare import QUANTITIES, mean_over, select, sweep
from .store import Row

MARKERS = ("o", "s", "^", "D", "v", "P")
_AXES = {"psnr": "PSNR (dB)", "ms_ssim": "MS-SSIM", "ef_psnr": "EF-PSNR (dB)", "ef_ssim": "edge SSIM"}
_LARGEST_ERROR = 0.3


def plot_against_n(path: Path, rows: Sequence[Row], methods: Sequence[str]) -> None:
    """Plot the four figures against N: means over the images that all methods have at that N."""
    plot, axes = figure(2, 2, width=9.0, height=6.8)
    ticks = sorted({row.n for row in rows if row.method in methods})
    for axis, quantity in zip(axes.flat, QUANTITIES, strict=True):
        _plot_means(axis, rows, methods, "n", quantity)
        axis.set(xlabel="number of Gaussians N", ylabel=_AXES[quantity], xscale="log")
        axis.set_xticks(ticks, [f"{n:,}" for n in ticks], fontsize=8, rotation=30)
        axis.minorticks_off()
    add_legend(plot, axes.flat[0], columns=5)
    save_figure(plot, path)


def plot_against_bits(path: Path, rows: Sequence[Row], methods: Sequence[str]) -> None:
    """Plot PSNR and EF-PSNR of the decoded files against their bits per pixel."""
    from matplotlib.ticker import LogLocator

    plot, axes = figure(1, 2, width=9.0, height=4.2)
    for axis, quantity in zip(axes, ("psnr", "ef_psnr"), strict=True):
        _plot_means(axis, rows, methods, "bits_per_pixel", f"decoded_{quantity}")
        axis.set(xlabel="bits per pixel of the .kcgs file", ylabel=f"{_AXES[quantity]}, decoded", xscale="log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("")
    add_legend(plot, axes[0], columns=5)
    save_figure(plot, path)


def plot_images(path: Path, lines: Sequence[Mapping[str, Tensor]], *, side_names: Sequence[str] = ()) -> None:
    """Show images, a line for each mapping, with their titles above.

    Args:
        path: .png or .jpg.
        lines: images (3, H, W) by title; (H, W) is an error, shown in colours of its own.
        side_names: of the lines.
    """
    height, width = next(iter(lines[0].values())).shape[-2:]
    columns = max(map(len, lines))
    size = {"width": 2.15 * columns, "height": (2.15 * height / width + 0.42) * len(lines)}
    plot, axes = figure(len(lines), columns, **size)
    grid = np.reshape(axes, (len(lines), columns))
    for row, line in zip(grid, lines, strict=True):
        for axis, (title, image) in zip(row, line.items(), strict=False):
            if image.ndim == 2:
                axis.imshow(image.numpy(), cmap="magma", vmin=0.0, vmax=_LARGEST_ERROR)
            else:
                axis.imshow(image.permute(1, 2, 0).numpy(), interpolation="nearest")
            axis.set_title(title, fontsize=7.5)
    for row, name in zip(grid, side_names, strict=False):
        row[0].set_ylabel(name, fontsize=8)
    for axis in grid.flat:
        axis.set(xticks=[], yticks=[])
        axis.grid(False)
    save_figure(plot, path)


def plot_changes(path: Path, changes: Mapping[str, Mapping[str, tuple[float, float]]]) -> None:
    """Plot changes in PSNR and EF-PSNR, a line for each row, a panel for each title.

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
        heights = range(len(rows))[::-1]
        axis.axvline(0.0, color="black", linewidth=0.8)
        axis.plot([psnr for psnr, _ in rows.values()], heights, "o", color=COLORS[0], label="PSNR")
        axis.plot([ef for _, ef in rows.values()], heights, "s", color=COLORS[1], markersize=4, label="EF-PSNR")
        axis.set_yticks(heights, list(rows))
        axis.set_ylim(-0.6, len(rows) - 0.4)
        axis.set(xlabel="change (dB)")
        axis.set_title(title, fontsize=8)
    add_legend(plot, panels[0], columns=2)
    save_figure(plot, path)


def add_legend(plot: Any, axis: Any, *, columns: int, where: str = "lower") -> None:
    """Name what an axis shows, below all axes or above them."""
    handles, names = axis.get_legend_handles_labels()
    plot.legend(handles, names, loc=f"outside {where} center", ncols=min(len(names), columns), fontsize=8)


def window(labels: Tensor, height: int, width: int) -> tuple[slice, slice]:
    """Find the part of an image with the most contour in it."""
    band = edge_band(labels).float()[None, None]
    height, width = min(height, labels.shape[0]), min(width, labels.shape[1])
    stride = max(1, min(height, width) // 8)
    density = torch.nn.functional.avg_pool2d(band, (height, width), stride)[0, 0]
    row, column = divmod(int(density.argmax()), density.shape[1])
    y, x = row * stride, column * stride
    return slice(y, y + height), slice(x, x + width)


def _plot_means(axis: Any, rows: Sequence[Row], methods: Sequence[str], across: str, quantity: str) -> None:
    swept, images = sweep(rows, methods)
    for index, name in enumerate(methods):
        found = [same for n in swept if (same := select(rows, name, n, images))]
        points = [(mean_over(same, across), y) for same in found if (y := mean_over(same, quantity)) == y]
        if points:
            style = {"color": COLORS[index], "marker": MARKERS[index], "markersize": 4.5, "label": name}
            axis.plot(*zip(*points, strict=True), **style)
