"""Give the smooth filling of a hole the texture of places whose smooth colours are alike."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

# what a blur of this deviation in pixels takes away is texture; what is stronger than all but this share of it, letters
# or a chain, would be known again: it is weakened to that
_BLUR, _TAIL = 6.0, 0.1
# places are compared in so many cells at most, and texture is copied over so many different distances
_MOST_CELLS, _MOST_SHIFTS = 2_000, 12
# a distance of the image's longer side counts as much as this difference of colours; what is not known, as much as that
_FAR, _NOT_KNOWN = 0.5, 3.0
# texture is not made stronger than this share asks for, where little of what it is mixed from is known
_LEAST_SHARE = 0.2


def texture(image: Tensor, hole: Tensor) -> Tensor:
    """Return the texture that is to be added to a smooth hole.

    Convention: it is copied over a few distances, chosen one after another, each the one that brings the hole's cells
    nearest to the colours of the cells that it copies from. Where two meet they are mixed so that the contrast stays.

    Args:
        image: :math:`(C, H, W)` on the CPU, the hole filled smoothly.
        hole: :math:`(H, W)` bool, not all of it.

    Returns:
        Of the image's shape, 0 outside the hole.
    """
    from scipy.ndimage import gaussian_filter

    side = math.ceil((hole.numel() / _MOST_CELLS) ** 0.5)
    cells = avg_pool2d(image[None].float(), side, ceil_mode=True)[0]
    shifts, shares = _shifts(cells, max_pool2d(hole[None].float(), side, ceil_mode=True)[0] > 0)
    soft = interpolate(avg_pool2d(shares[None], 3, 1, 1), scale_factor=side, mode="bilinear")[0]
    fine = image - torch.from_numpy(gaussian_filter(image.numpy(), (0, _BLUR, _BLUR), mode="nearest"))
    bound = torch.from_numpy(np.quantile(fine[:, ~hole].abs().numpy(), 1 - _TAIL, axis=1))[:, None, None]
    fine = fine.clamp(-bound, bound)
    y, x = hole.nonzero().T
    total, squares = image.new_zeros(len(image), len(y)), image.new_zeros(len(y))
    for (down, right), share in zip((side * shifts).tolist(), soft, strict=True):
        rows, cols, known = _sources(hole, y + down, x + right)
        weight = share[y, x] * known
        total += weight * fine[:, rows, cols]
        squares += weight**2
    result = torch.zeros_like(image)
    result[:, y, x] = total / squares.sqrt().clamp_min(_LEAST_SHARE)
    return result


def _shifts(cells: Tensor, hole: Tensor) -> tuple[Tensor, Tensor]:
    """Return shifts (K, 2) in cells, down and right, and where each is the best, (K, H, W) of 0 and 1."""
    y, x = hole.nonzero().T
    # every second, as on a chessboard
    shifts = torch.cartesian_prod(*(torch.arange(1 - n, n) for n in hole.shape))[::2]
    rows, cols, known = _sources(hole, y + shifts[:, :1], x + shifts[:, 1:])
    cost = (cells[:, rows, cols] - cells[:, None, y, x]).square().sum(0)
    cost += (_FAR / max(hole.shape)) ** 2 * shifts.square().sum(1)[:, None]
    cost[~known] = _NOT_KNOWN
    best, chosen = cost.new_full((len(y),), _NOT_KNOWN), list[int]()
    for _ in range(_MOST_SHIFTS):
        chosen.append(int(torch.minimum(cost, best).sum(1).argmin()))
        best = torch.minimum(best, cost[chosen[-1]])
    shares = cost.new_zeros(_MOST_SHIFTS, *hole.shape)
    shares[cost[chosen].argmin(0), y, x] = 1.0
    return shifts[chosen], shares


def _sources(hole: Tensor, rows: Tensor, cols: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return places inside the image, and whether they are the ones that were asked for, and known."""
    y, x = rows.clamp(0, hole.shape[0] - 1), cols.clamp(0, hole.shape[1] - 1)
    return y, x, (y == rows) & (x == cols) & ~hole[y, x]
