"""Figures of fits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from kcgs._atomic import atomic_path
from kcgs.functional import psnr
from kcgs.plots import COLORS, figure, save_figure

from .compare import QUANTITIES, mean_over, select, sweep
from .store import Row
from .tables import db

# a figure of the worst crops, their side in pixels, and how many
CROPS, _CROP, _CROPS = "crops.png", 128, 3
Crop = tuple[float, dict[str, Tensor]]
# of a sheet as JPEG
_SHEET_QUALITY = 65
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


def plot_images(path: Path, *rows: Mapping[str, Tensor]) -> None:
    """Show rows of images (3, H, W) of one size beside each other, with their titles above."""
    height, width = next(iter(rows[0].values())).shape[-2:]
    size = {"width": 2.15 * len(rows[0]), "height": len(rows) * (2.15 * height / width + 0.42)}
    plot, axes = figure(len(rows), len(rows[0]), **size)
    images = [shown for row in rows for shown in row.items()]
    for axis, (title, image) in zip(np.ravel(axes), images, strict=True):
        axis.imshow(image.permute(1, 2, 0).numpy(), interpolation="nearest")
        axis.set_title(title, fontsize=7.5)
        axis.set(xticks=[], yticks=[])
        axis.grid(False)
    save_figure(plot, path)


def plot_crops(path: Path, frames: Iterable[tuple[str, Mapping[str, Tensor]]]) -> None:
    """Show where the second image of a frame is furthest from its first, in three crops, at most two of a frame."""
    found = list[Crop]()
    for name, images in frames:
        photo, ours = list(images.values())[:2]
        found += cut_crops(name, images, (ours - photo).square().mean(0), 2)
    rows = [row for _, row in sorted(found, key=lambda crop: -crop[0])[:_CROPS]]
    if rows:
        plot_images(path, *rows)


def cut_crops(name: str, images: Mapping[str, Tensor], errors: Tensor, most: int) -> Iterator[Crop]:
    """Yield the crops of highest mean error, of (H, W), apart from each other: that mean, and the images there.

    The first image has the title `name` and the place, the others theirs and the PSNR to the first.
    """
    size = min(_CROP, *errors.shape)
    step = size // 8
    means = avg_pool2d(errors[None], size, step)[0]
    for _ in range(most):
        row, column = divmod(int(means.argmax()), means.shape[1])
        y, x, error = row * step, column * step, float(means[row, column])
        if math.isinf(error):
            return
        # a copy: the frame can go
        crops = {title: image[:, y : y + size, x : x + size].clone() for title, image in images.items()}
        (_, photo), *others = crops.items()
        titled = {f"{title}, {db(float(psnr(crop, photo)))} dB": crop for title, crop in others}
        yield error, {f"{name}, x = {x}, y = {y}": photo, **titled}
        means[max(0, row - 7) : row + 8, max(0, column - 7) : column + 8] = -math.inf


def save_sheet(path: Path, frames: Iterable[tuple[str, Mapping[str, Tensor]]]) -> None:
    """Write whole frames at full size, a row of images for each, none where there are none."""
    rows = [torch.cat([image.clamp(0, 1) for image in images.values()], 2) for _, images in frames]
    if rows:
        width = max(row.shape[2] for row in rows)
        sheet = torch.cat([pad(row, (0, width - row.shape[2]), value=1.0) for row in rows], 1)
        pixels = (255 * sheet).round().byte().permute(1, 2, 0).numpy()
        with atomic_path(path) as temporary:
            Image.fromarray(pixels).save(temporary, quality=_SHEET_QUALITY, optimize=True)


def show_crops(folder: Path, name: str) -> list[str]:
    """Return a report's lines on these crops, where they were made."""
    text = f"Where `{name}` is furthest from the photo, in at most two crops of an image, with the PSNR there."
    return [text, f"![]({CROPS})"] if (folder / CROPS).is_file() else []


def add_legend(plot: Any, axis: Any, *, columns: int, where: str = "lower") -> None:
    """Name what an axis shows, below all axes or above them."""
    handles, names = axis.get_legend_handles_labels()
    plot.legend(handles, names, loc=f"outside {where} center", ncols=min(len(names), columns), fontsize=8)
