"""Merging regions whose contours save too little error for their length."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs._labels import check_labels
from kcgs.errors import InvalidArgument

from .contour_fit import contour_gain
from .contour_windows import check_image_and_labels

# squared error, mean over channels, that a pixel of contour must save: what Gaussians would save with its bits
MERGE_COST = 0.003
_MIN_SHARE = 0.1  # share of the error that three in four windows must save: colours then differ along most of a contour
_BAND = 12.0  # pixels across a contour over which its error counts: windows reach 6 to each side
_ROUNDS = 8  # most rounds of merging and judging again


def merge_regions(
    image: Tensor, labels: Tensor, merge_cost: float = MERGE_COST, objects: Tensor | None = None
) -> Tensor:
    """Merge regions whose contour saves less error than Gaussians would save with its bits.

    Convention: what a contour saves is predicted from the pixels near it: the error of one quadratic colour less the
    error of two linear colours mixed across the contour. The default is the cost of one to two bits per pixel of
    contour; as lossless WebP the maps of `auto` take 3.5 bits, and Gaussians of as many bytes save more. A contour that
    saves less than a tenth of the error in a quarter of its windows counts as saving nothing, as contours across
    texture do. Contours that save least are merged first, and the new map is judged again, eight times at most.

    Args:
        image: :math:`(C, H, W)` floating in [0, 1].
        labels: :math:`(H, W)` integer, non-negative.
        merge_cost: squared error that a pixel of contour must save, at least 0.
        objects: :math:`(H, W)` integer, a coarser map: regions of two objects do not merge, and none lies in two;
            None: all may merge.

    Returns:
        :math:`(H, W)` int64; merged regions have the id of one of them.

    Raises:
        TypeError, ValueError: as :func:`kcgs.functional.choose_softness`; a negative cost.

    Example:
        >>> image = torch.zeros(3, 32, 48)
        >>> image[:, :, 16:] = 1.0
        >>> labels = (torch.arange(48) // 16).expand(32, 48)
        >>> merge_regions(image, labels)[0, ::16].tolist()
        [0, 1, 1]
    """
    check_number("merge_cost", merge_cost, 0.0)
    labels = check_labels("labels", labels)
    check_image_and_labels(image, labels)
    ids, labels = torch.unique(labels, return_inverse=True)
    owners = torch.zeros_like(ids)
    if objects is not None:
        objects = check_labels("objects", objects, dims=(2,)).to(ids)
        if objects.shape != labels.shape:
            raise InvalidArgument("objects", f"shape {tuple(labels.shape)}", tuple(objects.shape), verb="have")
        owners[labels] = objects
        if (crossing := owners[labels] != objects).any():
            received = f"a contour through the region {int(ids[labels[crossing][0]])}"
            raise InvalidArgument("objects", "a map that labels divide further", received)
    for _ in range(_ROUNDS):
        gains = contour_gain(image, labels)
        saved = {
            pair: _BAND * (gain.smooth_error - gain.contour_error) * (gain.share >= _MIN_SHARE)
            for pair, gain in gains.items()
        }
        costly = sorted(
            (value, (a, b)) for (a, b), value in saved.items() if value < merge_cost and owners[a] == owners[b]
        )
        if not costly:
            break
        # a region merges once per round, so that the larger region is judged before it merges again
        target = torch.arange(int(labels.max()) + 1, device=labels.device)
        merged: set[int] = set()
        for _value, (a, b) in costly:
            if not merged & {a, b}:
                target[b] = a
                merged |= {a, b}
        labels = target[labels]
    new_labels: Tensor = ids[labels].long()
    return new_labels
