"""Points inside of regions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad


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
    from scipy.ndimage import distance_transform_edt, maximum_position

    regions = pad(labels.cpu(), (1, 1, 1, 1), value=-1)
    is_border = torch.zeros_like(regions, dtype=torch.bool)
    for dim in (0, 1):
        differs = regions.diff(dim=dim) != 0
        before, after = [0, 0, 0, 0], [0, 0, 0, 0]
        before[2 * (1 - dim)], after[2 * (1 - dim) + 1] = 1, 1
        is_border |= pad(differs, before) | pad(differs, after)
    inner = ~is_border[1:-1, 1:-1].numpy()
    # the nearest border pixel is of the same region, and one pixel from the outside
    distances = distance_transform_edt(np.pad(inner, 1))[1:-1, 1:-1] + 1
    index = labels.cpu().numpy()
    places = np.array(maximum_position(distances, index, np.arange(index.max() + 1)))
    return torch.from_numpy(places[:, ::-1].copy()), torch.from_numpy(distances[places[:, 0], places[:, 1]])
