"""Move the contours of a label map onto the edges of the image."""

import numpy as np
from numpy.typing import NDArray

from kcgs.maps import Labels, RegionGraph

from .images import lab_sums

# a region is thin if less than this share of its pixels lies deeper inside than `reach`
_CORE_SHARE = 0.1
# distance of a mixed colour from the line between the two colours, in lengths of that line
_MIXTURE_TOLERANCE = 0.25
# smallest visible distance of two colours in Lab
_JUST_NOTICEABLE = 2.3
# standard deviation of the smoothing before the gradient, in pixels
_GRADIENT_SIGMA = 0.7


def snap_contours(lab: NDArray[np.float32], regions: Labels, reach: int) -> Labels:
    """Move contours of regions 0 to R - 1 by up to ``reach`` pixels onto the strongest edge of (H, W, 3).

    Segmenters that smooth the image leave contours a pixel or two beside its edges, with whiskers, and turn blurred
    edges into thin regions. Here every region keeps its pixels that are deeper inside than ``reach``; the watershed on
    the gradient in CIE Lab divides the other pixels. A thin region is dissolved if its colour is a mixture of two
    neighbours, or hardly differs from one; other thin regions stay. A region may fall into several pieces.
    """
    from scipy.ndimage import binary_dilation
    from skimage.segmentation import watershed

    fixed = _fixed_pixels(lab, regions, reach)
    # the watershed needs only the open pixels and their rim
    seeds = np.where(fixed, regions + 1, 0)
    band = binary_dilation(~fixed, np.ones((3, 3)))
    flooded = watershed(_gradient(lab), seeds, mask=band)
    return np.where(fixed, regions, flooded - 1)


def _fixed_pixels(lab: NDArray[np.float32], regions: Labels, reach: int) -> NDArray[np.bool_]:
    """Return the mask of the pixels that keep their label, (H, W)."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * reach + 1
    core = minimum_filter(regions, size, mode="nearest") == maximum_filter(regions, size, mode="nearest")
    areas = np.bincount(regions.ravel())
    thin = np.bincount(regions[core], minlength=len(areas)) < _CORE_SHARE * areas
    if thin.all():  # the watershed would have no seed
        return np.ones_like(core)
    graph = RegionGraph(regions)
    means = lab_sums(lab, regions) / areas[:, None]
    is_line = np.zeros_like(thin)
    for region in np.flatnonzero(thin):
        is_line[region] = not _is_mixture(means[region], means[list(graph.borders[region])])
    return np.asarray(core | is_line[regions])


def _is_mixture(color: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
    """Return whether a colour (3,) hardly differs from one of ``others`` (N, 3) or lies between two of them."""
    offsets = color - others
    if np.linalg.norm(offsets, axis=1).min() < _JUST_NOTICEABLE:
        return True
    lines = others[None] - others[:, None]
    squared = np.maximum((lines**2).sum(axis=-1), 1e-12)
    along = (offsets[:, None] * lines).sum(axis=-1) / squared
    beside = np.linalg.norm(offsets[:, None] - along[..., None] * lines, axis=-1)
    return bool(((along > 0) & (along < 1) & (beside < _MIXTURE_TOLERANCE * np.sqrt(squared))).any())


def _gradient(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    from scipy.ndimage import gaussian_gradient_magnitude

    squared = [gaussian_gradient_magnitude(lab[..., k], _GRADIENT_SIGMA) ** 2 for k in range(3)]
    return np.asarray(np.sqrt(sum(squared)), dtype=np.float32)
