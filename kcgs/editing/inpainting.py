"""Unknown pixels of an image, as means of what is around them or copies of other places."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, one_hot, pad

# side of the blocks that are compared, in pixels
_BLOCK = 4
# blocks around a part of the unknown ones that are compared
_RING = 4
# blocks around a block whose errors are averaged
_WINDOW = 2
# a hole is cut into parts of the size of this share of it, each with a place of its own
_PART = 1 / 8
# mean squared error, summed over channels, from which on no place is copied
_LARGEST_ERROR = 0.2
# weight of the difference of a copy and the smooth continuation: conspicuous things are not copied
_SMOOTH_WEIGHT = 0.2
# blocks over which copies of two places are blended
_BLEND = 2
# largest difference of image and copy that is continued; with more, an edge that only one of them has tints the hole
_LARGEST_DIFFERENCE = 0.1


def inpaint(image: Tensor, unknown: Tensor) -> Tensor:
    """Continue an image (C, H, W) smoothly into its unknown pixels, (H, W) bool; one pixel at least is known.

    Source: Gortler, Grzeszczuk, Szeliski and Cohen, "The Lumigraph", 1996: pull and push.
    """
    return torch.where(unknown, _pull_push(image, (~unknown).to(image)[None]), image)


def inpaint_from_matches(image: Tensor, unknown: Tensor) -> Tensor:
    """Copy places that look like the surroundings into unknown pixels.

    Each part of the unknown pixels finds a place, and each pixel copies the place whose error in the surroundings,
    smoothly continued, is the least. Copies are shifted by a smooth continuation of the difference around them. Without
    such a place it is `inpaint`.
    """
    height, width = unknown.shape
    smooth = inpaint(image, unknown)
    blocks = avg_pool2d(smooth, _BLOCK, ceil_mode=True)
    hole = max_pool2d(unknown[None].to(image), _BLOCK, ceil_mode=True)[0]
    offsets = _matches(blocks, hole)
    costs = torch.stack([torch.full_like(hole, _LARGEST_ERROR), *(_cost(blocks, hole, *o) for o in offsets)])
    shares = one_hot(costs.argmin(0), len(costs)).movedim(-1, 0).to(image)
    shares = avg_pool2d(shares, 2 * _BLEND + 1, 1, _BLEND, count_include_pad=False)
    shares = interpolate(shares[None], scale_factor=_BLOCK, mode="bilinear")[0, :, None, :height, :width]
    copy = shares[0] * smooth
    for share, (dy, dx) in zip(shares[1:], offsets, strict=True):
        copy += share * smooth.roll((-_BLOCK * dy, -_BLOCK * dx), (-2, -1))
    difference = (image - copy).clamp(-_LARGEST_DIFFERENCE, _LARGEST_DIFFERENCE)
    return torch.where(unknown, copy + inpaint(difference, unknown), image)


def _matches(blocks: Tensor, hole: Tensor) -> list[tuple[int, int]]:
    """Return the rows and columns from each part of a hole to the place that differs least from what is around it."""
    height, width = hole.shape
    side = max(_RING, round((_PART * float(hole.sum())) ** 0.5))
    known, squares, shape = 1 - hole, blocks.square().sum(0), (2 * height, 2 * width)
    spectra = torch.fft.rfft2(torch.cat([torch.stack([known, known * squares]), known * blocks]), s=shape)
    offsets = set()
    for y, x in product(range(0, height, side), range(0, width, side)):
        cell = slice(y, y + side), slice(x, x + side)
        if not hole[cell].any():
            continue
        part = torch.zeros_like(hole)
        part[cell] = hole[cell]
        ring = known * max_pool2d(part[None], 2 * _RING + 1, 1, _RING)[0]
        if not ring.any():
            continue
        # correlated, the sum of (blocks - place)^2 - _LARGEST_ERROR over known blocks of the place, for each offset
        factors = torch.stack([ring * squares - _LARGEST_ERROR * (ring + part), ring])
        factors = torch.fft.rfft2(torch.cat([factors, -2 * ring * blocks]), s=shape).conj()
        error = torch.fft.irfft2((factors * spectra).sum(0), s=shape)
        dy, dx = divmod(int(error.argmin()), shape[1])
        offsets.add((dy - shape[0] * (dy >= height), dx - shape[1] * (dx >= width)))
    return sorted(offsets)


def _cost(blocks: Tensor, hole: Tensor, dy: int, dx: int) -> Tensor:
    """Return the error of the place at an offset for each block, (H, W): infinite where the place is unknown."""
    known = 1 - hole
    source = pad(known, (-min(dx, 0), max(dx, 0), -min(dy, 0), max(dy, 0)))
    source = source[max(dy, 0) :, max(dx, 0) :][: hole.shape[0], : hole.shape[1]]
    error = (blocks - blocks.roll((-dy, -dx), (-2, -1))).square().sum(0)
    both = torch.stack([known * source, known * source * error, hole * error])
    share, around, inside = avg_pool2d(both, 2 * _WINDOW + 1, 1, _WINDOW)
    cost = inpaint((around / share.clamp_min(1e-9))[None], (hole > 0) | (share < 1e-9))[0] + _SMOOTH_WEIGHT * inside
    lost = max_pool2d(1 - source[None], 2 * _BLEND + 3, 1, _BLEND + 1)[0] > 0
    return torch.where(lost | ~share.any(), torch.inf, cost)


def _pull_push(image: Tensor, weight: Tensor) -> Tensor:
    """Fill where the weight (1, H, W) is below 1 from the image at half the size, filled in the same way."""
    height, width = weight.shape[1:]
    if height * width == 1:
        return image
    even = 0, width % 2, 0, height % 2
    sums, shares = (avg_pool2d(pad(t, even), 2) for t in (image * weight, weight))
    coarse = _pull_push(sums / shares.clamp_min(1e-9), (4 * shares).clamp_max(1.0))
    smooth = interpolate(coarse[None], scale_factor=2, mode="bilinear")[0, :, :height, :width]
    return smooth.lerp(image, weight)
