"""What the tutorials of this folder share: settings, a photo, and images side by side."""

from __future__ import annotations

import os

import matplotlib.pyplot as plt
import torch
from skimage import data
from torch import Tensor

QUICK = os.environ.get("KCGS_QUICK") == "1"  # True in tests: smaller images, shorter fits
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")  # distinct with any colour vision
BLUE, ORANGE = COLORS[:2]


def set_up() -> None:
    """Set the size of figures and of their text."""
    plt.rcParams.update({"figure.dpi": 80, "font.size": 10})


def photo(name: str, height: int) -> Tensor:
    """Return a photo that comes with scikit-image, (3, height, W) in [0, 1]."""
    pixels = torch.from_numpy(getattr(data, name)()).permute(2, 0, 1).float() / 255
    size = (height, height * pixels.shape[2] // pixels.shape[1])
    return torch.nn.functional.interpolate(pixels[None], size, mode="bilinear", antialias=True)[0].clamp(0, 1)


def show(images: dict[str, Tensor], width: float = 2.4) -> None:
    """Show images (C, H, W) in [0, 1] side by side under their names; `width` is that of one image, in inches."""
    rows, columns = next(iter(images.values())).shape[1:]
    size = (width * len(images), width * rows / columns + 0.3)
    _, axes = plt.subplots(1, len(images), figsize=size, layout="constrained", squeeze=False)
    for axis, (name, image) in zip(axes.flat, images.items(), strict=True):
        axis.imshow(image.detach().clamp(0, 1).permute(1, 2, 0).numpy())
        axis.set_title(name)
        axis.set_axis_off()


def show_rows(rows: dict[str, list[Tensor]], titles: list[str], side: float = 0.95) -> None:
    """Show rows of images (C, H, W), each row beside its name, and titles over the first; `side` is as `width`."""
    size = (side * len(titles) + 1, side * len(rows) + 0.2)
    _, axes = plt.subplots(len(rows), len(titles), figsize=size, layout="constrained", squeeze=False)
    for line, (name, images) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(name)
        for axis, image in zip(line, images, strict=True):
            axis.imshow(image.clamp(0, 1).permute(1, 2, 0), interpolation="nearest")
            axis.set(xticks=[], yticks=[])
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
