"""Images side by side, for the tutorials of this folder."""

from __future__ import annotations

import matplotlib.pyplot as plt
from torch import Tensor


def show(images: dict[str, Tensor], width: float = 2.4) -> None:
    """Show images (C, H, W) in [0, 1] side by side under their names; `width` is that of one image, in inches."""
    rows, columns = next(iter(images.values())).shape[1:]
    size = (width * len(images), width * rows / columns + 0.3)
    _, axes = plt.subplots(1, len(images), figsize=size, layout="constrained", squeeze=False)
    for axis, (name, image) in zip(axes.flat, images.items(), strict=True):
        axis.imshow(image.detach().clamp(0, 1).permute(1, 2, 0).numpy())
        axis.set_title(name)
        axis.set_axis_off()
