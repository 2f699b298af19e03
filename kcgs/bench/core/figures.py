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


def plot_against_n(path: Path, rows: Sequence[Row], methods: Sequence[str]) -> None:
    """Plot the four figures against N: means over the images that all methods have at that N."""
    plot, axes = figure(2, 2, width=9.0, height=6.8)
    ticks, images = sweep(rows, methods)
    for axis, quantity in zip(axes.flat, QUANTITIES, strict=True):
        for index, name in enumerate(methods):
            found = [same for n in ticks if (same := select(rows, name, n, images))]
            points = [(same[0].n, y) for same in found if (y := mean_over(same, quantity)) == y]
            if points:
                style = {"color": COLORS[index], "marker": MARKERS[index], "markersize": 4.5, "label": name}
                axis.plot(*zip(*points, strict=True), **style)
        axis.set(xlabel="number of Gaussians N", ylabel=_AXES[quantity], xscale="log")
        axis.set_xticks(ticks, [f"{n:,}" for n in ticks], fontsize=8, rotation=30)
        axis.minorticks_off()
    add_legend(plot, axes.flat[0], columns=5)
    save_figure(plot, path)


def plot_images(path: Path, lines: Sequence[Mapping[str, Tensor]], *, side_names: Sequence[str] = ()) -> None:
    """Show images, a line for each mapping, with their titles above.

    Args:
        path: .png or .jpg.
        lines: images (3, H, W) by title.
        side_names: of the lines.
    """
    height, width = next(iter(lines[0].values())).shape[-2:]
    columns = max(map(len, lines))
    size = {"width": 2.15 * columns, "height": (2.15 * height / width + 0.42) * len(lines)}
    plot, axes = figure(len(lines), columns, **size)
    grid = np.reshape(axes, (len(lines), columns))
    for row, line in zip(grid, lines, strict=True):
        for axis, (title, image) in zip(row, line.items(), strict=False):
            axis.imshow(image.permute(1, 2, 0).numpy(), interpolation="nearest")
            axis.set_title(title, fontsize=7.5)
    for row, name in zip(grid, side_names, strict=False):
        row[0].set_ylabel(name, fontsize=8)
    for axis in grid.flat:
        axis.set(xticks=[], yticks=[])
        axis.grid(False)
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
