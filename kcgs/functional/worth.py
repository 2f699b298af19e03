"""Contours that save enough error for their length."""

from __future__ import annotations

import torch
from torch import Tensor

from .widths import band_gain, check_picture

# squared error, channels averaged, that a pixel of contour must save: what its bits save where Gaussians spend them
PRICE = 0.003
# pixels on both sides of a contour whose error it bears on
_BAND = 12.0
_ROUNDS = 8


def merge_worthless(image: Tensor, labels: Tensor, price: float = PRICE) -> Tensor:
    """Unite regions whose contour saves less error than its bits would, spent on Gaussians.

    What a contour saves is predicted from the pixels about it (:func:`kcgs.functional.band_gain`): how much better two
    linear colours explain them than one quadratic one. Labels are not free: the price is that of codes of one to two
    bits a pixel of contour; as lossless WebP the maps of `auto` take 3.5, and lose to Gaussians of as many bytes. The
    least worthy contours go first, and what is left is judged anew.

    Args:
        image: :math:`(C, H, W)` floating in [0, 1].
        labels: :math:`(H, W)` integer, non-negative.
        price: squared error that a pixel of contour must save, at least 0.

    Returns:
        :math:`(H, W)` int64; united regions have the id of one of them; one region where no contour is worth it.

    Raises:
        TypeError, ValueError: as :func:`kcgs.functional.band_gain`; a negative price.

    Example:
        >>> image = torch.zeros(3, 32, 48)
        >>> image[:, :, 16:] = 1.0
        >>> labels = (torch.arange(48) // 16).expand(32, 48)
        >>> merge_worthless(image, labels)[0, ::16].tolist()
        [0, 1, 1]
    """
    if not price >= 0.0:
        raise ValueError(f"price must be at least 0; got {price!r}")
    check_picture(image, labels)
    ids, labels = torch.unique(labels, return_inverse=True)
    for _ in range(_ROUNDS):
        gains = band_gain(image, labels)
        worth = {pair: _BAND * (gain.smooth - gain.soft) for pair, gain in gains.items()}
        worthless = sorted((value, pair) for pair, value in worth.items() if value < price)
        if not worthless:
            break
        # a region merges once a round, so that what it has become is judged before it grows on
        into = torch.arange(int(labels.max()) + 1, device=labels.device)
        taken: set[int] = set()
        for _value, (a, b) in worthless:
            if not taken & {a, b}:
                into[b] = a
                taken |= {a, b}
        labels = into[labels]
    united: Tensor = ids[labels].long()
    return united
