"""The default segmenter: clean regions of photos, without learned weights."""

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs._labels import check_labels
from kcgs.compiled import image_threads_for_kernels
from kcgs.errors import InvalidArgument
from kcgs.functional import merge_regions
from kcgs.maps import Labels, compact
from kcgs.segment.cleanup import Cleanup, Prediction, clean, connect, merge_similar, merge_small, to_regions
from kcgs.segment.images import lab_sums, reduce_image, rgb_to_lab
from kcgs.segment.registry import register, segment_with_scores
from kcgs.segment.snapping import snap_contours

# Tuned by the agreement of contours with human ones on photos of BSDS500, and by the gain of a fit: see `auto`.
# standard deviation of the smoothing, in pixels
_SIGMA = 1.2
# scales of Felzenszwalb and Huttenlocher; the next scale is tried if there are few regions that are not flat
_SCALES = (300.0, 150.0, 75.0)
# with at least so many regions no finer scale is tried
_MIN_REGIONS = 4
# regions are flat below this root mean square distance from their mean colour, in Lab, where 2.3 is just noticeable
_FLAT = 3.0
# share of a finer region that must lie in one coarser region, so that it becomes a part of this region
_PART_SHARE = 0.9
# largest number of pixels at which images are segmented; contours are then snapped at full size
_MAX_PIXELS = 500_000
# pixels of an image above which regions are also merged at the smaller size
_LARGE = 2 * 1920 * 1080


@register("auto", Cleanup(max_regions=30), takes_cleanup=True)
@image_threads_for_kernels
def auto(image: Tensor, *, objects: Any = None, cleanup: Cleanup) -> Prediction:
    """Segment a photo into up to 30 clean connected regions, or fewer if contours would save too little error.

    This is the method of Felzenszwalb and Huttenlocher. Its scale is halved up to twice, while it gives fewer than 4
    regions and these are not nearly flat. Contours snap to edges, and pieces under ``min_size`` join a neighbour.
    Neighbours merge if their contour saves less error than it costs (`merge_regions`); then the most similar neighbours
    merge until ``max_regions`` are left. An image that needs no contour gives one region.

    On 21 photos of BSDS500, about three fifths of the contours are within 3 pixels of a human contour, and half of the
    human contours are within 3 pixels of one of these. Texture, soft transitions and foliage have no contour where
    colours hardly differ across it. With 400 Gaussians a fit gains 0.52 dB by these maps (`python -m benchmarks maps`).

    With objects, no region crosses the contour of an object, so that an object consists of whole regions. Regions have
    the names of their objects.

    Args:
        image: as `segment` takes it, any size.
        objects: a label map of the image's size, as :func:`kcgs.fit` takes it, whose ids are the names; or "object":
            the main object, found by the method "object"; None: areas of similar colour only. Pieces of objects under
            ``min_size`` join their surroundings.
        cleanup: its ``min_size`` and ``max_regions`` hold here, too; its ``snap`` must be 0 with objects.

    Raises:
        TypeError, ValueError: ``objects`` is no label map of the image's size, or in more pieces than ``max_regions``;
            errors of the method "object".

    Example:
        >>> from kcgs.segment import segment
        >>> image = torch.zeros(3, 40, 60)
        >>> image[0, 10:30, 10:50] = 1.0
        >>> labels = segment(image, "auto")
        >>> labels.unique().tolist(), labels[20, 30].item()
        ([0, 1], 1)
    """
    image = image.cpu()
    min_size, max_regions = cleanup.min_pixels(image[0].numel()), cleanup.max_regions
    if objects is None:
        return Prediction(_divide(image, None, min_size, max_regions))
    if cleanup.snap:
        raise InvalidArgument("snap", "0 with objects, whose contours stay", cleanup.snap)
    owners, names = _find_objects(image, objects, min_size)
    pieces = int(connect(owners).max()) + 1
    if max_regions is not None and pieces > max_regions:
        raise InvalidArgument("max_regions", f"at least {pieces}, the number of pieces of objects", max_regions)
    regions = _divide(image, owners, min_size, max_regions)
    owner_of_region = np.zeros(int(regions.max()) + 1, np.int64)
    owner_of_region[regions] = owners
    return Prediction(regions, names=[names[owner] for owner in owner_of_region])


def _find_objects(image: Tensor, objects: Any, min_size: int) -> tuple[Labels, list[str]]:
    """Return a map of objects without small pieces, with labels from 0, and the name of each label."""
    if isinstance(objects, str) and objects == "object":
        labels, _, names = segment_with_scores(image, "object", min_size=min_size)
        assert names is not None
        return labels.numpy(), [names[label] for label in range(len(names))]
    labels = check_labels("objects", objects, dims=(2,)).cpu()
    if labels.shape != image.shape[1:]:
        raise InvalidArgument("objects", f"of the image's size {tuple(image.shape[1:])}", tuple(labels.shape))
    ids, index = compact(labels)
    return merge_small(index.numpy().astype(np.int64), min_size), [str(label) for label in ids.tolist()]


def _divide(image: Tensor, objects: Labels | None, min_size: int, max_regions: int | None) -> Labels:
    """Return the regions of an image; no region crosses the contour of an object."""
    if image[0].numel() <= _LARGE:
        regions = _regions(image, objects, min_size)
    else:
        small, smallest = _reduce(image, min_size)
        parts = None if objects is None else _resize(objects, small.shape[1:])
        regions = merge_similar(small, _regions(small, parts, smallest), max_regions, parts)
        regions = _enlarge(image, regions)
    if objects is None:
        return regions
    return merge_similar(image, clean(regions, min_size, objects), max_regions, objects)


def _reduce(image: Tensor, min_size: int) -> tuple[Tensor, int]:
    """Return an image of at most `_MAX_PIXELS`, and the least size of regions there, in pixels."""
    small = reduce_image(image, _MAX_PIXELS)
    return small, max(1, round(min_size * small[0].numel() / image[0].numel()))


def _regions(image: Tensor, objects: Labels | None, min_size: int) -> Labels:
    """Return the regions at the coarsest scale that gives enough of them, less contours that save too little error."""
    best = np.zeros(image.shape[1:], dtype=np.int64) if objects is None else clean(objects, 1)
    if (image != image[:, :1, :1]).any():
        for scale in _SCALES:
            best = _refine(best, _felzenszwalb_regions(image, scale, min_size, objects), min_size, objects)
            if best.max() + 1 >= _MIN_REGIONS or _spread(image, best) < _FLAT:
                break
    if best.max() == 0:
        return best
    apart = None if objects is None else torch.from_numpy(objects)
    return merge_regions(image, torch.from_numpy(best), objects=apart).numpy()


def _felzenszwalb_regions(image: Tensor, scale: float, min_size: int, objects: Labels | None) -> Labels:
    """Return 4-connected regions of (3, H, W), of at least ``min_size`` pixels, contours on edges."""
    from skimage.segmentation import felzenszwalb

    small, smallest = _reduce(image, min_size)
    # Lab over 100 has about the range of RGB in [0, 1], for which scales are usually given
    raw = felzenszwalb(rgb_to_lab(small) / 100, scale=scale, sigma=_SIGMA, min_size=smallest)
    return clean(_enlarge(image, clean(raw, smallest)), min_size, objects)


def _enlarge(image: Tensor, regions: Labels) -> Labels:
    """Return regions at the size of (3, H, W), with contours on its edges."""
    if regions.shape != image.shape[1:]:
        regions = to_regions(_resize(regions, image.shape[1:]))
    shrink = max(1.0, math.sqrt(image[0].numel() / _MAX_PIXELS))
    return snap_contours(rgb_to_lab(image), regions, math.ceil(2 * shrink))


def _resize(labels: Labels, size: tuple[int, ...]) -> Labels:
    """Resize a label map: each pixel takes the label of the nearest pixel."""
    maps = torch.from_numpy(labels)[None, None].double()
    return F.interpolate(maps, size, mode="nearest")[0, 0].long().numpy()


def _refine(coarse: Labels, fine: Labels, min_size: int, objects: Labels | None) -> Labels:
    """Divide regions of ``coarse`` by the regions of ``fine`` that lie within a single coarse region.

    The coarse map has better contours: regions of the fine map that cross them are ignored.
    """
    count = int(coarse.max()) + 1
    overlap = np.bincount((fine * count + coarse).ravel(), minlength=count * (int(fine.max()) + 1)).reshape(-1, count)
    parent = overlap.argmax(axis=1)
    is_part = overlap.max(axis=1) > _PART_SHARE * np.bincount(fine.ravel())
    return clean(np.where(is_part[fine] & (parent[fine] == coarse), count + fine, coarse), min_size, objects)


def _spread(image: Tensor, regions: Labels) -> float:
    """Return the root mean square distance of colours from their region's mean, in Lab."""
    lab = rgb_to_lab(image)
    means = lab_sums(lab, regions) / np.bincount(regions.ravel())[:, None]
    return float(np.sqrt(((lab - means[regions]) ** 2).sum(axis=-1).mean()))
