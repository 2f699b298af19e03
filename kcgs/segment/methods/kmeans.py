"""Regions of similar colours."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_number
from kcgs.segment.cleanup import Cleanup
from kcgs.segment.clustering import k_means
from kcgs.segment.images import rgb_to_lab
from kcgs.segment.registry import register


@register("kmeans", Cleanup(snap=2, max_regions=20))
def kmeans(image: Tensor, *, num_clusters: int = 6, sigma: float = 1.0) -> NDArray[np.int64]:
    """Cluster the colours by k-means in CIE Lab, take the connected pieces, and merge the most similar neighbours.

    Args:
        image: as `segment` takes it.
        num_clusters: k, at least 1.
        sigma: standard deviation of the smoothing before clustering, in pixels, at least 0.

    Example:
        >>> import torch
        >>> from kcgs.segment import segment
        >>> image = torch.zeros(3, 20, 30)
        >>> image[0, :, 10:], image[1, :, 20:] = 1.0, 1.0
        >>> segment(image, "kmeans", num_clusters=3, sigma=0.0)[0, ::10].tolist()
        [0, 1, 2]
    """
    from scipy.ndimage import gaussian_filter

    check_number("sigma", sigma, 0)
    lab = gaussian_filter(rgb_to_lab(image).astype(np.float64), (sigma, sigma, 0), mode="nearest")
    return k_means(lab.reshape(-1, 3), num_clusters).reshape(lab.shape[:2])
