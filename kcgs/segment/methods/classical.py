"""Segmentation without learned weights: nothing to download, the same map every time."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._check import check_count, check_number
from kcgs.functional import merge_regions
from kcgs.kernels import image_threads_for_kernels
from kcgs.segment.cleanup import (
    check_segment_image,
    clean,
    connected_regions,
    lab_sums,
    merge_similar,
    rgb_to_lab,
    to_pixels,
)
from kcgs.segment.registry import Cleanup, register
from kcgs.segment.snapping import snap_contours

_SIGMA = 1.2
# Tried in turn while a map has few regions and they are not nearly flat (root mean square distance from the
# mean colour, in Lab, where 2.3 is just noticeable).
_SCALES = (300.0, 150.0, 75.0)
_FEWEST = 4
_FLAT = 3.0
# The share of a finer region that must lie in one coarser region for the finer one to be part of it.
_PART_SHARE = 0.9
# Larger images are segmented at this many pixels; only their contours are set at full size.
_MAX_PIXELS = 500_000
# Of images larger than this, regions are also compared and merged at so many pixels: the full size says no more.
_LARGE = 2 * 1920 * 1080


@register("auto", Cleanup(max_regions=30))
@image_threads_for_kernels
def auto(image: Tensor, *, min_size: int, max_regions: int | None) -> Tensor:
    """Segment a photo into up to 30 clean connected regions, fewer where contours would save too little.

    The method of Felzenszwalb and Huttenlocher, with its scale halved up to twice while fewer than 4 regions
    come out that are not nearly flat; contours snap to edges, pieces under ``min_size`` join a neighbour;
    regions merge whose contour saves less error than it costs (`merge_regions`), and then the most similar
    neighbours until ``max_regions`` are left. A scene that needs no contour gives one region. On 21 photos of
    BSDS500 some three fifths of the contours lie within 3 pixels of human ones, and of the human ones are
    found; borders of texture alone are not seen. With 400 Gaussians a fit gains 0.76 dB by these maps, and
    loses 0.65 dB to Gaussians of as many bytes where a map is stored as lossless WebP (`python -m benchmarks maps`).

    Args:
        image: as `segment` takes it, any size; result and errors are those of `segment` too.
        min_size: of `Cleanup`, as are ``max_regions``, ``snap`` and ``connected``.
        max_regions: of `Cleanup`.

    Example:
        >>> image = torch.zeros(3, 40, 60)
        >>> image[0, 10:30, 10:50] = 1.0
        >>> labels = auto(image)
        >>> labels.unique().tolist(), labels[20, 30].item()
        ([0, 1], 1)
    """
    image = image.cpu()
    if image[0].numel() <= _LARGE:
        return _auto_regions(image, min_size)
    small = _reduced(image)
    smallest = max(1, round(min_size * small[0].numel() / image[0].numel()))
    return _enlarged(image, merge_similar(small, _auto_regions(small, smallest), max_regions))


def _auto_regions(image: Tensor, min_size: int) -> Tensor:
    best = torch.zeros(image.shape[1:], dtype=torch.int64)
    if (image != image[:, :1, :1]).any():
        for scale in _SCALES:
            best = _cut_out(best, _photo_regions(image, scale, min_size), min_size)
            if best.max() + 1 >= _FEWEST or _spread(image, best) < _FLAT:
                break
    return merge_regions(image, best) if best.max() > 0 else best


@register("felzenszwalb")
@image_threads_for_kernels
def felzenszwalb(image: Tensor, *, scale: float = 300.0, sigma: float = 1.0, min_size: int) -> Tensor:
    """Segment by the graph-based method of Felzenszwalb and Huttenlocher (IJCV 2004), in CIE Lab.

    Args:
        image: as `segment` takes it; result and errors are those of `segment` too.
        scale: preference for larger regions, above 0. The same value suits a photo at any size.
        sigma: standard deviation of the smoothing beforehand, in pixels, at least 0.
        min_size: of `Cleanup`, as are ``max_regions``, ``snap`` and ``connected``.

    Example:
        >>> image = torch.zeros(1, 20, 30)
        >>> image[..., 12:] = 1.0
        >>> felzenszwalb(image, sigma=0.0)[0, ::10].tolist()
        [1, 1, 0]
    """
    check_number("scale", scale, 0, above=True)
    check_number("sigma", sigma, 0)
    return _graph_regions(image, scale, sigma, min_size)


def _graph_regions(image: Tensor, scale: float, sigma: float, min_size: int) -> Tensor:
    from skimage.segmentation import felzenszwalb as graph_based

    # Lab over 100 has about the range of RGB in [0, 1], for which the usual scales are known.
    raw = graph_based(rgb_to_lab(image) / 100, scale=scale, sigma=sigma, min_size=min_size)
    return clean(torch.from_numpy(raw), min_size)


@register("slic", Cleanup(snap=2, max_regions=20))
@image_threads_for_kernels
def slic(image: Tensor, *, num_segments: int = 400, compactness: float = 10.0, max_regions: int | None) -> Tensor:
    """Segment into SLIC superpixels (Achanta et al., TPAMI 2012) and merge the most similar neighbours.

    Regions come out of similar size; `auto` follows objects better.

    Args:
        image: as `segment` takes it; result and errors are those of `segment` too.
        num_segments: about how many superpixels to merge, at least 1.
        compactness: weight of position against colour, above 0.
        max_regions: of `Cleanup`, as are ``min_size``, ``snap`` and ``connected``.

    Example:
        >>> image = torch.zeros(3, 20, 30)
        >>> image[:, :, 10:] = 1.0
        >>> slic(image, num_segments=24, max_regions=2)[0, ::10].tolist()
        [1, 0, 0]
    """
    check_count("num_segments", num_segments)
    check_number("compactness", compactness, 0, above=True)
    from skimage.segmentation import slic as superpixels

    raw = superpixels(to_pixels(image), num_segments, compactness, start_label=0, channel_axis=-1)
    return merge_similar(image, connected_regions(torch.from_numpy(raw)), max_regions)


def _photo_regions(image: Tensor, scale: float, min_size: int) -> Tensor:
    """Return 4-connected regions of (3, H, W), none a speck, contours on edges."""
    small = _reduced(image)
    smallest = max(1, round(min_size * small[0].numel() / image[0].numel()))
    return clean(_enlarged(image, _graph_regions(small, scale, _SIGMA, smallest)), min_size)


def _shrink(image: Tensor) -> float:
    return max(1.0, math.sqrt(image[0].numel() / _MAX_PIXELS))


def _reduced(image: Tensor) -> Tensor:
    """Return (3, H, W) at no more pixels than regions are looked for at."""
    shrink = _shrink(image)
    if shrink == 1:
        return image
    size = [max(1, round(side / shrink)) for side in image.shape[1:]]
    return check_segment_image(F.interpolate(image[None], size, mode="area")[0])


def _enlarged(image: Tensor, labels: Tensor) -> Tensor:
    """Return labels at the size of (3, H, W), contours on its edges."""
    if labels.shape != image.shape[1:]:
        labels = F.interpolate(labels[None, None].double(), image.shape[1:], mode="nearest")[0, 0].long()
    return snap_contours(image, labels, reach=math.ceil(2 * _shrink(image)))


def _cut_out(coarse: Tensor, fine: Tensor, min_size: int) -> Tensor:
    """Cut regions of ``fine`` out of the one region of ``coarse`` that they are part of.

    The coarse map has the better contours: what crosses them in the finer map is left out.
    """
    count = int(coarse.max()) + 1
    shared = (fine * count + coarse).flatten().bincount(minlength=count * (int(fine.max()) + 1))
    share, host = (shared.reshape(-1, count) / fine.flatten().bincount()[:, None]).max(dim=1)
    cut = (share > _PART_SHARE)[fine] & (host[fine] == coarse)
    return clean(torch.where(cut, count + fine, coarse), min_size)


def _spread(image: Tensor, labels: Tensor) -> float:
    """Return the root mean square distance of colours from their region's mean, in Lab."""
    lab, regions = rgb_to_lab(image), labels.numpy()
    means = lab_sums(lab, regions) / np.bincount(regions.ravel())[:, None]
    return float(np.sqrt(((lab - means[regions]) ** 2).sum(axis=-1).mean()))
