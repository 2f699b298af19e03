"""Figures of fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

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


def plot_images(path: Path, images: Mapping[str, Tensor]) -> None:
    """Show images (3, H, W) of one size beside each other, with their titles above."""
    height, width = next(iter(images.values())).shape[-2:]
    plot, axes = figure(1, len(images), width=2.15 * len(images), height=2.15 * height / width + 0.42)
    for axis, (title, image) in zip(np.ravel(axes), images.items(), strict=True):
        axis.imshow(image.permute(1, 2, 0).numpy(), interpolation="nearest")
        axis.set_title(title, fontsize=7.5)
        axis.set(xticks=[], yticks=[])
        axis.grid(False)
    save_figure(plot, path)


def add_legend(plot: Any, axis: Any, *, columns: int, where: str = "lower") -> None:
    """Name what an axis shows, below all axes or above them."""
    handles, names = axis.get_legend_handles_labels()
    plot.legend(handles, names, loc=f"outside {where} center", ncols=min(len(names), columns), fontsize=8)
