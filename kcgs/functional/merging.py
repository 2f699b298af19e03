"""Contours that save enough error for their length."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs._check import check_number

from .widths import band_gain, check_problem

# squared error, channels averaged, that a pixel of contour must save: what its bits save where Gaussians spend them
MERGE_COST = 0.003
# pixels on both sides of a contour whose error it bears on
_BAND = 12.0
_ROUNDS = 8


def merge_regions(image: Tensor, labels: Tensor, merge_cost: float = MERGE_COST) -> Tensor:
    """Merge regions whose contour saves less error than its bits would save if Gaussians had them.

    Convention: what a contour saves is predicted from the pixels about it (:func:`kcgs.functional.band_gain`): how much
    better two linear colours explain them than one quadratic one. The default cost is that of one to two bits per pixel
    of contour; as lossless WebP the maps of `auto` take 3.5 bits, and lose to Gaussians of as many bytes. The
    contours that save least go first, and what is left is judged anew, eight times at most.

    Args:
        image: :math:`(C, H, W)` floating in [0, 1].
        labels: :math:`(H, W)` integer, non-negative.
        merge_cost: squared error that a pixel of contour must save, at least 0.

    Returns:
        :math:`(H, W)` int64; merged regions have the id of one of them; one region where no contour saves its cost.

    Raises:
        TypeError, ValueError: as :func:`kcgs.functional.band_gain`; a negative cost.

    Example:
        >>> image = torch.zeros(3, 32, 48)
        >>> image[:, :, 16:] = 1.0
        >>> labels = (torch.arange(48) // 16).expand(32, 48)
        >>> merge_regions(image, labels)[0, ::16].tolist()
        [0, 1, 1]
    """
    check_number("merge_cost", merge_cost, 0.0)
    check_problem(image, labels)
    ids, labels = torch.unique(labels, return_inverse=True)
    for _ in range(_ROUNDS):
        gains = band_gain(image, labels)
        saved = {pair: _BAND * (gain.smooth - gain.soft) for pair, gain in gains.items()}
        costly = sorted((value, pair) for pair, value in saved.items() if value < merge_cost)
        if not costly:
            break
        # a region merges once per round, so that what it has become is judged before it merges again
        into = torch.arange(int(labels.max()) + 1, device=labels.device)
        taken: set[int] = set()
        for _value, (a, b) in costly:
            if not taken & {a, b}:
                into[b] = a
                taken |= {a, b}
        labels = into[labels]
    merged: Tensor = ids[labels].long()
    return merged
