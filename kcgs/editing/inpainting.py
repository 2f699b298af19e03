"""Unknown pixels of an image, as means of what is around them or copies of another place."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

# pixels around the unknown ones that are compared, too
_RING = 16
# side of the blocks that are compared and copied, in pixels
_BLOCK = 2
# mean squared error, summed over channels, from which on no place is copied
_LARGEST_ERROR = 0.2
# largest difference of image and copy that is continued; with more, an edge that only one of them has tints the hole
_LARGEST_DIFFERENCE = 0.1


def inpaint(image: Tensor, unknown: Tensor) -> Tensor:
    """Continue an image (C, H, W) smoothly into its unknown pixels, (H, W) bool; one pixel at least is known.

    Source: Gortler, Grzeszczuk, Szeliski and Cohen, "The Lumigraph", 1996: pull and push.
    """
    return torch.where(unknown, _pull_push(image, (~unknown).to(image)[None]), image)


def inpaint_from_match(image: Tensor, unknown: Tensor) -> Tensor:
    """Copy the place that looks most like the surroundings, at half the size, into unknown pixels.

    The copy is shifted by a smooth continuation of the difference around it. Without such a place it is `inpaint`.
    """
    height, width = unknown.shape
    blocks = avg_pool2d(inpaint(image, unknown), _BLOCK, ceil_mode=True)
    hole = max_pool2d(unknown[None].to(image), _BLOCK, ceil_mode=True)[0]
    place = blocks.roll(_match(blocks, hole), (-2, -1))
    place = interpolate(place[None], scale_factor=_BLOCK, mode="bilinear")[0, :, :height, :width]
    difference = (image - place).clamp(-_LARGEST_DIFFERENCE, _LARGEST_DIFFERENCE)
    return torch.where(unknown, place + inpaint(difference, unknown), image)


def _match(blocks: Tensor, hole: Tensor) -> tuple[int, int]:
    """Return by how many rows and columns the place moves that differs least from a hole and its surroundings."""
    reach = _RING // _BLOCK
    compared = max_pool2d(hole[None], 2 * reach + 1, 1, reach)[0]
    known, squares = 1 - hole, blocks.square().sum(0)
    shape = [2 * n for n in hole.shape]

    def correlation(a: Tensor, b: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(a, s=shape).conj() * torch.fft.rfft2(b, s=shape)
        sums: Tensor = torch.fft.irfft2(spectrum, s=shape)
        return sums

    # the sum of (blocks - place)^2 - _LARGEST_ERROR over known blocks of the place, for each offset
    error = correlation(compared * squares, known) + correlation(compared, known * squares)
    error -= 2 * correlation(compared * blocks, known * blocks).sum(0)
    error -= _LARGEST_ERROR * correlation(compared, known)
    # the place of the hole lies in the image
    error[correlation(hole, torch.ones_like(hole)) < 0.999 * hole.sum()] = torch.inf
    row, column = divmod(int(error.argmin()), shape[1])
    return shape[0] - row, shape[1] - column


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
