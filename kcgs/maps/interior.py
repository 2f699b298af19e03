"""Points inside of regions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def interior_points(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Find the pixel of each region that is farthest from its contour and from the border of the image.

    Args:
        labels: (H, W), ids 0 to R - 1, each in use.

    Returns:
        x and y of the pixels, (R, 2) int64 on the CPU, and how far they are from the nearest pixel outside of their
        region, (R,) float64.

    Example:
        >>> labels = torch.zeros(5, 9, dtype=torch.long)
        >>> labels[:, 5:] = 1
        >>> [values.tolist() for values in interior_points(labels)]
        [[[2, 2], [7, 3]], [3.0, 2.0]]
    """
    from scipy import ndimage

    index = labels.cpu().numpy()
    padded, cross = np.pad(index, 1, constant_values=-1), ndimage.generate_binary_structure(2, 1)
    inner = ndimage.minimum_filter(padded, footprint=cross) == ndimage.maximum_filter(padded, footprint=cross)
    inner[[0, -1]] = inner[:, [0, -1]] = False
    # the transform measures to the nearest border pixel of the region, which is one pixel from the outside
    distances = ndimage.distance_transform_edt(inner)[1:-1, 1:-1] + 1
    places = np.array(ndimage.maximum_position(distances, index, np.arange(index.max() + 1)))
    return torch.from_numpy(places[:, ::-1].copy()), torch.from_numpy(distances[places[:, 0], places[:, 1]])
