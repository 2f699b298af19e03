"""What an encoder may leave out of a label map that follows another: jitter of contours."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kcgs._check import check_count
from kcgs.codec.file import MOST_REGIONS

_MOST = 32


def settle_labels(labels: Any, predicted: Any, tolerance: int = 2, *, smooth: float = 2.0) -> Any:
    """Keep the predicted labels where a given map differs from them by no more than jitter.

    The given map is smoothed first: a pixel takes the region that has most of a Gaussian about it. The pixels that
    differ are opened by a disc with a diameter of `tolerance` + 1 pixels: what no such disc inside them covers keeps
    the predicted label. Every region of the given map has a pixel in the result, and no other region has.

    Args:
        labels: :math:`(H, W)` integers, the map that is given: positions of regions, from 0.
        predicted: :math:`(H, W)` integers, as `move_labels` predicts it.
        tolerance: thickness in pixels of what is left out, 1 to 32; 0 gives the map itself.
        smooth: standard deviation of the Gaussian in pixels, 0 (none) to 32.

    Returns:
        :math:`(H, W)`, in the type of ``labels``.

    Raises:
        ValueError: the maps differ in size, or an argument is out of range.

    Example:
        >>> labels = np.zeros((6, 8), np.int32)
        >>> predicted = labels.copy()
        >>> labels[:, 5:] = predicted[:, 6:] = 1
        >>> bool((settle_labels(labels, predicted, 1) == predicted).all())
        True
        >>> bool((settle_labels(labels, predicted, 0) == labels).all())
        True
    """
    labels, predicted = np.asarray(labels), np.asarray(predicted)
    if labels.ndim != 2 or labels.shape != predicted.shape or not labels.size:
        raise ValueError(f"labels and predicted must be (H, W) of one size; got {labels.shape} and {predicted.shape}")
    check_count("tolerance", tolerance, 0, _MOST)
    if not 0 <= smooth <= _MOST:
        raise ValueError(f"smooth must be 0 to {_MOST}; got {smooth}")
    if min(labels.min(), predicted.min()) < 0:
        raise ValueError("labels and predicted must be 0 or more; got negative ones")
    if tolerance == 0 or (labels == predicted).all():
        return labels.copy()
    regions = 1 + max(labels.max(), predicted.max())
    check_count("number of regions", int(regions), 1, MOST_REGIONS)
    return _settled(labels.astype(np.int32), predicted, regions, tolerance, smooth).astype(labels.dtype)


def _settled(labels: Any, predicted: Any, regions: int, tolerance: int, smooth: float) -> Any:
    present = np.zeros(regions, bool)
    present[labels] = True
    target = _smoothed(labels, smooth) if smooth else labels
    differs = target != predicted
    changed = ~present[predicted]
    rows, columns = np.flatnonzero(differs.any(1)), np.flatnonzero(differs.any(0))
    if len(rows):
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        changed[box] |= _opened(differs[box], tolerance + 1)
    while True:
        settled = np.where(changed, target, predicted)
        lost = present.copy()
        lost[settled] = False
        if not lost.any():
            return settled
        # at the places that they have in the given map, whatever else was there
        again = lost[labels]
        target, changed = np.where(again, labels, target), changed | again


def _smoothed(labels: Any, sigma: float) -> Any:
    """Give each pixel the region that has most of a Gaussian about it."""
    from scipy.ndimage import find_objects, gaussian_filter

    largest = int(np.bincount(labels.ravel()).argmax())
    most, rest = np.zeros(labels.shape, np.float32), np.ones(labels.shape, np.float32)
    smoothed = np.full_like(labels, largest)
    margin = math.ceil(2 * sigma)
    for region, found in enumerate(find_objects(labels + 1)):
        if found is None or region == largest:
            continue
        box = tuple(slice(max(0, side.start - margin), side.stop + margin) for side in found)
        share = gaussian_filter((labels[box] == region).astype(np.float32), sigma, mode="nearest", truncate=2.0)
        rest[box] -= share
        smoothed[box][share > most[box]] = region
        np.maximum(most[box], share, out=most[box])
    smoothed[rest > most] = largest
    return smoothed


def _opened(mask: Any, diameter: int) -> Any:
    """Return what discs inside the mask cover."""
    place = 2 * np.arange(diameter) - (diameter - 1)
    disc = np.argwhere(place[:, None] ** 2 + place**2 <= diameter**2)
    height, width = mask.shape
    padded = np.pad(mask, diameter)
    inside = np.ones((height + diameter, width + diameter), bool)
    for dy, dx in disc:
        inside &= padded[dy : dy + inside.shape[0], dx : dx + inside.shape[1]]
    covered = np.zeros((height + 2 * diameter, width + 2 * diameter), bool)
    for dy, dx in disc:
        covered[dy : dy + inside.shape[0], dx : dx + inside.shape[1]] |= inside
    return covered[diameter : diameter + height, diameter : diameter + width]
