"""The default segmenter: clean regions of photos, without learned weights."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs.compiled import image_threads_for_kernels
from kcgs.functional import merge_regions
from kcgs.maps import Labels
from kcgs.segment.cleanup import Cleanup, clean, merge_similar, to_regions
from kcgs.segment.images import lab_sums, reduce_image, rgb_to_lab
from kcgs.segment.registry import register
from kcgs.segment.snapping import snap_contours

# Tuned by how contours agree with those of people on photos of BSDS500, and what a fit gains: see `auto`.
# standard deviation of the smoothing, in pixels
_SIGMA = 1.2
# scales of Felzenszwalb and Huttenlocher: the next one is tried while regions are few and not flat
_SCALES = (300.0, 150.0, 75.0)
# regions from which on no finer scale is tried
_MIN_REGIONS = 4
# root mean square distance from the mean colour of a region that counts as flat, in Lab, where 2.3 is just noticeable
_FLAT = 3.0
# share of a finer region that must lie in one coarser region for the finer one to be a part of it
_PART_SHARE = 0.9
# pixels at which images are segmented, at most; contours are then snapped at full size
_MAX_PIXELS = 500_000
# pixels of an image above which regions are also merged at the smaller size
_LARGE = 2 * 1920 * 1080


@register("auto", Cleanup(max_regions=30))
@image_threads_for_kernels
def auto(image: Tensor, *, min_size: int, max_regions: int | None) -> Tensor:
    """Segment a photo into up to 30 clean connected regions, fewer where contours would save too little.

    The method of Felzenszwalb and Huttenlocher, with its scale halved up to twice while fewer than 4 regions result
    that are not nearly flat. Contours snap to edges, and pieces under ``min_size`` join a neighbour. Regions merge
    whose contour saves less error than it costs (`merge_regions`), then the most similar neighbours until
    ``max_regions`` are left. An image that needs no contour gives one region.

    On 21 photos of BSDS500 some three fifths of the contours lie within 3 pixels of human ones, and half of the human
    ones have a contour within 3 pixels. Where no colour differs across most of a contour, as along texture, soft
    transitions and foliage, there is none. With 400 Gaussians a fit gains 0.53 dB by these maps
    (`python -m benchmarks maps`).

    Example:
        >>> from kcgs.segment import segment
        >>> image = torch.zeros(3, 40, 60)
        >>> image[0, 10:30, 10:50] = 1.0
        >>> labels = segment(image, "auto")
        >>> labels.unique().tolist(), labels[20, 30].item()
        ([0, 1], 1)
    """
    image = image.cpu()
    if image[0].numel() <= _LARGE:
        return torch.from_numpy(_regions(image, min_size))
    small = reduce_image(image, _MAX_PIXELS)
    smallest = max(1, round(min_size * small[0].numel() / image[0].numel()))
    regions = _regions(small, smallest)
    if max_regions is not None:
        regions = merge_similar(rgb_to_lab(small), regions, max_regions)
    return torch.from_numpy(_enlarge(image, regions))


def _regions(image: Tensor, min_size: int) -> Labels:
    best = np.zeros(image.shape[1:], dtype=np.int64)
    if (image != image[:, :1, :1]).any():
        for scale in _SCALES:
            best = _refine(best, _felzenszwalb_regions(image, scale, min_size), min_size)
            if best.max() + 1 >= _MIN_REGIONS or _spread(image, best) < _FLAT:
                break
    return merge_regions(image, torch.from_numpy(best)).numpy() if best.max() > 0 else best


def _felzenszwalb_regions(image: Tensor, scale: float, min_size: int) -> Labels:
    """Return 4-connected regions of (3, H, W), of at least ``min_size`` pixels, contours on edges."""
    from skimage.segmentation import felzenszwalb

    small = reduce_image(image, _MAX_PIXELS)
    smallest = max(1, round(min_size * small[0].numel() / image[0].numel()))
    # Lab over 100 has about the range of RGB in [0, 1], for which scales are usually given
    raw = felzenszwalb(rgb_to_lab(small) / 100, scale=scale, sigma=_SIGMA, min_size=smallest)
    return clean(_enlarge(image, clean(raw, smallest)), min_size)


def _shrink(image: Tensor) -> float:
    return max(1.0, math.sqrt(image[0].numel() / _MAX_PIXELS))


def _enlarge(image: Tensor, regions: Labels) -> Labels:
    """Return regions at the size of (3, H, W), with contours on its edges."""
    if regions.shape != image.shape[1:]:
        maps = torch.from_numpy(regions)[None, None].double()
        regions = to_regions(F.interpolate(maps, image.shape[1:], mode="nearest")[0, 0].long().numpy())
    return snap_contours(rgb_to_lab(image), regions, math.ceil(2 * _shrink(image)))


def _refine(coarse: Labels, fine: Labels, min_size: int) -> Labels:
    """Divide regions of ``coarse`` by the regions of ``fine`` that lie within one of them.

    The coarse map has the better contours: a region of the finer map that crosses them is left out.
    """
    count = int(coarse.max()) + 1
    overlap = np.bincount((fine * count + coarse).ravel(), minlength=count * (int(fine.max()) + 1)).reshape(-1, count)
    parent = overlap.argmax(axis=1)
    is_part = overlap.max(axis=1) > _PART_SHARE * np.bincount(fine.ravel())
    return clean(np.where(is_part[fine] & (parent[fine] == coarse), count + fine, coarse), min_size)


def _spread(image: Tensor, regions: Labels) -> float:
    """Return the root mean square distance of colours from their region's mean, in Lab."""
    lab = rgb_to_lab(image)
    means = lab_sums(lab, regions) / np.bincount(regions.ravel())[:, None]
    return float(np.sqrt(((lab - means[regions]) ** 2).sum(axis=-1).mean()))
