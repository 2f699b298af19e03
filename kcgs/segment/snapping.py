"""Putting the contours of a label map where the image has its edges."""

import numpy as np
from numpy.typing import NDArray

from kcgs.functional.merging import Labels, RegionGraph
from kcgs.segment.images import lab_sums

# A region with a smaller share of its pixels further than `reach` inside is a ribbon.
_CORE_SHARE = 0.1
# How far a ribbon's colour may lie beside the line between its neighbours' colours, in lengths of that line.
_MIXTURE_TOLERANCE = 0.25
_JUST_NOTICEABLE = 2.3  # A distance in Lab.
_GRADIENT_SIGMA = 0.7


def snap_contours(lab: NDArray[np.float32], regions: Labels, reach: int) -> Labels:
    """Move contours of regions 0 to R - 1 by up to ``reach`` pixels onto the strongest edge of (H, W, 3).

    Segmenters that smooth the image leave contours a pixel or two beside its edges, put whiskers along them and make
    ribbons of blurred edges. Here every region keeps what lies further than ``reach`` inside it, and the rest goes by
    watershed on the gradient in CIE Lab. Ribbons whose colour is a mixture of the regions on their two sides, or hardly
    another than one of them, are dissolved; other regions too thin to have an inside stay as they are. A region can
    come out in several pieces.
    """
    from scipy.ndimage import binary_dilation
    from skimage.segmentation import watershed

    fixed = _fixed(lab, regions, reach)
    # The watershed runs in the band that is open and on its rim: the inside of regions has no say in it.
    seeds = np.where(fixed, regions + 1, 0)
    band = binary_dilation(~fixed, np.ones((3, 3)))
    flooded = watershed(_gradient(lab), seeds, mask=band)
    return np.where(fixed, regions, flooded - 1)


def _fixed(lab: NDArray[np.float32], regions: Labels, reach: int) -> NDArray[np.bool_]:
    """Return (H, W), true where the label stays."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * reach + 1
    core = minimum_filter(regions, size, mode="nearest") == maximum_filter(regions, size, mode="nearest")
    areas = np.bincount(regions.ravel())
    thin = np.bincount(regions[core], minlength=len(areas)) < _CORE_SHARE * areas
    if thin.all():  # Dissolving them would leave no seed.
        return np.ones_like(core)
    graph = RegionGraph(regions)
    means = lab_sums(lab, regions) / areas[:, None]
    stays = np.zeros_like(thin)
    for region in np.flatnonzero(thin):
        stays[region] = not _is_mixture(means[region], means[list(graph.borders[region])])
    return np.asarray(core | stays[regions])


def _is_mixture(color: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
    """Say whether ``color`` (3,) is hardly another than one of ``others`` (N, 3) or lies between two."""
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
