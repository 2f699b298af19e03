"""Segmentation without learned weights: nothing to download, the same map every time."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs.functional import merge_regions
from kcgs.segment.base import check_segment_image, register
from kcgs.segment.cleanup import (
    absorb_specks,
    check_count,
    check_number,
    connected_regions,
    lab_sums,
    merge_similar,
    order_by_area,
    rgb_to_lab,
)
from kcgs.segment.contours import snap_contours

# The smallest region as a share of the image: 600 pixels of 481 x 321. Below 250 x 250 pixels, where that is
# less than a line across the image, it is the length of such a line.
_MIN_SHARE = 0.004
_SIGMA = 1.2
_REACH = 2
# Tried in turn while a map has few regions and they are not nearly flat (root mean square distance from the
# mean colour, in Lab, where 2.3 is just noticeable).
_SCALES = (300.0, 150.0, 75.0)
_FEWEST = 4
_FLAT = 3.0
# The share of a finer region that must lie in one coarser region for the finer one to be part of it.
_PART_SHARE = 0.9
# Larger images are segmented at this many pixels; only their contours are set at full size.
_MAX_PIXELS = 500_000


@register("auto")
def auto(image: Tensor, *, max_regions: int = 30, min_size: int | None = None) -> Tensor:
    """Segment a photo into up to 30 clean connected regions, fewer where contours would save too little.

    The method of Felzenszwalb and Huttenlocher, with its scale halved up to twice while fewer than 4 regions
    come out that are not nearly flat; contours snap to edges, pieces under ``min_size`` are absorbed;
    regions unite whose contour saves less error than it costs (`merge_regions`), and then the most similar
    neighbours until ``max_regions`` are left. A scene that needs no contour gives one region. On 21 photos of
    BSDS500 some three fifths of the contours lie within 3 pixels of human ones, and of the human ones are
    found; borders of texture alone are not seen. With 400 Gaussians a fit gains 0.76 dB by these maps, and
    loses 0.65 dB to Gaussians of as many bytes where a map is stored as lossless WebP (`kcgs bench maps`).

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1], any size.
        max_regions: the most regions to return, at least 1.
        min_size: pixels of the smallest region, at least 1; None: 0.4 % of the image (small images: more).

    Returns:
        :math:`(H, W)` int64, 4-connected regions with ids 0 to R - 1 by decreasing area.

    Raises:
        TypeError: ``image`` is no floating tensor or a count no integer.
        ValueError: ``image`` has another shape, non-finite values or values outside [0, 1], or a count is below 1.

    Example:
        >>> image = torch.zeros(3, 40, 60)
        >>> image[0, 10:30, 10:50] = 1.0
        >>> labels = auto(image)
        >>> labels.unique().tolist(), labels[20, 30].item()
        ([0, 1], 1)
    """
    pixels = torch.from_numpy(check_segment_image(image)).permute(2, 0, 1)
    check_count("max_regions", max_regions)
    min_size = smallest_size(pixels[0].numel(), min_size)
    best = torch.zeros(pixels.shape[1:], dtype=torch.int64)
    if (pixels != pixels[:, :1, :1]).any():
        for scale in _SCALES:
            best = _cut_out(best, _photo_regions(pixels, scale, min_size), min_size)
            if best.max() + 1 >= _FEWEST or _spread(pixels, best) < _FLAT:
                break
    worthy = order_by_area(merge_regions(pixels, best)) if best.max() > 0 else best
    return order_by_area(merge_similar(pixels, worthy, max_regions)).to(image.device)


@register("felzenszwalb")
def felzenszwalb(
    image: Tensor,
    *,
    scale: float = 300.0,
    sigma: float = 1.0,
    max_regions: int | None = None,
    min_size: int | None = None,
    snap: bool | int = False,
) -> Tensor:
    """Segment by the graph-based method of Felzenszwalb and Huttenlocher (IJCV 2004), in CIE Lab.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1].
        scale: preference for larger regions, above 0. The same value suits a photo at any size.
        sigma: smoothing beforehand, in pixels, at least 0.
        max_regions: the most regions to return, at least 1; the most similar neighbours merge. None: no limit.
        min_size: pixels of the smallest region, at least 1; None: 0.4 % of the image (small images: more).
        snap: move contours by up to so many pixels onto the image's edges; True: 2, False: 0.

    Returns:
        :math:`(H, W)` int64, 4-connected regions with ids 0 to R - 1 by decreasing area.

    Raises:
        TypeError: ``image`` is no floating tensor or a count no integer.
        ValueError: ``image`` has another shape, non-finite values or values outside [0, 1], or a number is
            out of its range.

    Example:
        >>> image = torch.zeros(1, 20, 30)
        >>> image[..., 12:] = 1.0
        >>> felzenszwalb(image, sigma=0.0)[0, ::10].tolist()
        [1, 1, 0]
    """
    pixels = check_segment_image(image)
    check_number("scale", scale, positive=True)
    check_number("sigma", sigma)
    if max_regions is not None:
        check_count("max_regions", max_regions)
    reach = check_reach(snap)
    min_size = smallest_size(pixels.shape[0] * pixels.shape[1], min_size)
    from skimage.segmentation import felzenszwalb as graph_based

    # Lab over 100 has about the range of RGB in [0, 1], for which the usual scales are known.
    raw = graph_based(rgb_to_lab(pixels) / 100, scale=scale, sigma=sigma, min_size=min_size)
    labels = clean(torch.from_numpy(raw), min_size)
    if reach:
        labels = clean(snap_contours(image, labels, reach=reach), min_size)
    if max_regions is not None:
        labels = order_by_area(merge_similar(image, labels, max_regions))
    return labels.to(image.device)


@register("slic")
def slic(
    image: Tensor,
    *,
    num_segments: int = 400,
    compactness: float = 10.0,
    max_regions: int = 20,
    min_size: int | None = None,
    snap: bool | int = True,
) -> Tensor:
    """Segment into SLIC superpixels (Achanta et al., TPAMI 2012) and merge the most similar neighbours.

    Regions come out of similar size; `auto` follows objects better.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1].
        num_segments: about how many superpixels, at least 1.
        compactness: weight of position against colour, above 0.
        max_regions: the most regions to return, at least 1.
        min_size: pixels of the smallest region, at least 1; None: 0.4 % of the image (small images: more).
        snap: move contours by up to so many pixels onto the image's edges; True: 2, False: 0.

    Returns:
        :math:`(H, W)` int64, 4-connected regions with ids 0 to R - 1 by decreasing area.

    Raises:
        TypeError: ``image`` is no floating tensor or a count no integer.
        ValueError: ``image`` has another shape, non-finite values or values outside [0, 1], or a number is
            out of its range.

    Example:
        >>> image = torch.zeros(3, 20, 30)
        >>> image[:, :, 10:] = 1.0
        >>> slic(image, num_segments=24, max_regions=2)[0, ::10].tolist()
        [1, 0, 0]
    """
    pixels = check_segment_image(image)
    check_count("num_segments", num_segments)
    check_count("max_regions", max_regions)
    check_number("compactness", compactness, positive=True)
    reach = check_reach(snap)
    min_size = smallest_size(pixels.shape[0] * pixels.shape[1], min_size)
    from skimage.segmentation import slic as superpixels

    raw = superpixels(pixels, num_segments, compactness, start_label=0, channel_axis=-1)
    return reduce_regions(image, connected_regions(torch.from_numpy(raw)), max_regions, min_size, reach)


def _photo_regions(image: Tensor, scale: float, min_size: int) -> Tensor:
    """Return 4-connected regions of (3, H, W), none a speck, contours on edges."""
    shrink = max(1.0, math.sqrt(image[0].numel() / _MAX_PIXELS))
    small = image
    if shrink > 1:
        size = [max(1, round(side / shrink)) for side in image.shape[1:]]
        small = F.interpolate(image[None], size, mode="area")[0]
    smallest = max(1, round(min_size * small[0].numel() / image[0].numel()))
    labels = felzenszwalb(small, scale=scale, sigma=_SIGMA, min_size=smallest)
    if shrink > 1:
        labels = F.interpolate(labels[None, None].double(), image.shape[1:], mode="nearest")[0, 0].long()
    labels = snap_contours(image, labels, reach=math.ceil(2 * shrink))
    return clean(labels, min_size)


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
    lab, regions = rgb_to_lab(check_segment_image(image)), labels.numpy()
    means = lab_sums(lab, regions) / np.bincount(regions.ravel())[:, None]
    return float(np.sqrt(((lab - means[regions]) ** 2).sum(axis=-1).mean()))


def reduce_regions(image: Tensor, pieces: Tensor, max_regions: int, min_size: int, reach: int) -> Tensor:
    """Merge pieces by colour, set contours on edges, and clean: at most ``max_regions``, by decreasing area."""
    merged = merge_similar(image, pieces, max_regions)
    cleaned = clean(snap_contours(image, merged, reach=reach) if reach else merged, min_size)
    return order_by_area(merge_similar(image, cleaned, max_regions)).to(image.device)


def clean(labels: Tensor, min_size: int) -> Tensor:
    """Return 4-connected regions of at least ``min_size`` pixels, by decreasing area."""
    # Absorbing keeps ids, and pieces of one region that it joins become one piece: connect after it.
    return order_by_area(connected_regions(absorb_specks(labels, min_size)))


def check_reach(snap: bool | int) -> int:
    """Return by how many pixels contours may move onto edges."""
    if not isinstance(snap, int):
        raise TypeError(f"snap must be a number of pixels, or True or False; got {snap!r}")
    if snap < 0:
        raise ValueError(f"snap must be at least 0; got {snap}")
    return _REACH if snap is True else int(snap)


def smallest_size(pixels: int, given: int | None) -> int:
    """Return the pixels of the smallest region: what is given, else by the size of the image."""
    if given is None:
        return max(round(_MIN_SHARE * pixels), round(math.sqrt(pixels)))
    check_count("min_size", given)
    return given
