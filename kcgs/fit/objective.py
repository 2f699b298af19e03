"""What a fit lowers: the squared error, or one that is nearer to what the eye sees."""

from __future__ import annotations

import torch
from torch import Tensor

from .pursuit import halve

# weight of the error in averages of 1, 2, 4 and 8 pixels a side
_WEIGHTS = (1.0, 4.0, 16.0, 32.0)
# the error counts by the local variance, with this added, to this power
_LEAST_VARIANCE, _POWER = 0.03**2, -0.45
# standard deviation of the window of the local variance, and its side, in pixels of the level
_WINDOW, _SIDE = 4.0, 33


class VisualObjective:
    r"""The squared error on several scales, counted less where the image is busy.

    .. math:: E(r) = \sum_k \sum_p m_k(p)\, |(P_k r)(p)|^2, \quad
        m_k = w_k (v_k + 0.03^2)^{-0.45} / Z

    :math:`P_k` averages blocks of :math:`2^k \times 2^k` pixels, :math:`v_k` is the local variance of :math:`P_k`
    image, channels averaged, and Z makes the mean of all :math:`m_k` together 1. It is quadratic: its gradient is 2 H
    r, H linear, so that growth and colours work by it as by the squared error. Averages weigh more than their share, so
    texture that Gaussians are too few for keeps its mean rather than single strokes; busy places hide errors.

    Args:
        image: (C, H, W) in [0, 1].

    Example:
        >>> objective = VisualObjective(torch.rand(3, 32, 48, generator=torch.Generator().manual_seed(0)))
        >>> residual = torch.full((3, 32, 48), 0.1)
        >>> objective.apply(residual).shape, objective.value(residual) > 0
        (torch.Size([3, 32, 48]), True)
    """

    def __init__(self, image: Tensor) -> None:
        from kornia.filters import gaussian_blur2d

        masks: list[Tensor] = []
        plane = image
        for weight in _WEIGHTS:
            if masks:
                if min(plane.shape[1:]) < 2:
                    break
                plane = halve(_even(plane))
            # the variance does not change with a constant, and rounding does less harm to small numbers
            centred = (plane - plane.mean((1, 2), keepdim=True))[None]
            mean, square = (
                gaussian_blur2d(t, (_SIDE, _SIDE), (_WINDOW, _WINDOW), "replicate") for t in (centred, centred**2)
            )
            variance = (square - mean**2).clamp_min(0.0).mean((0, 1))
            masks.append(weight * (variance + _LEAST_VARIANCE) ** _POWER)
        total = sum(float(mask.mean()) for mask in masks)
        self.masks = [mask / total for mask in masks]
        self.importance = self.apply(torch.ones_like(image[:1]))[0]
        """What an error that is the same all around counts at each pixel, (H, W)."""

    @staticmethod
    def _sum_up(planes: list[Tensor]) -> Tensor:
        """Add to each plane what the blocks of the coarser ones have; the planes are written to."""
        for fine, coarse in zip(planes[-2::-1], planes[:0:-1], strict=True):
            height, width = coarse.shape[1:]
            blocks = fine[:, : 2 * height, : 2 * width].unflatten(2, (width, 2)).unflatten(1, (height, 2))
            blocks.add_(coarse[:, :, None, :, None])
        return planes[0]

    def apply(self, residual: Tensor) -> Tensor:
        """Return H r, (C, H, W): half the gradient at a residual r, render - image."""
        planes = [residual]
        for _ in self.masks[1:]:
            planes.append(halve(_even(planes[-1])))
        levels = enumerate(zip(planes, self.masks, strict=True))
        return self._sum_up([plane * (mask * 0.25**level) for level, (plane, mask) in levels])

    def value(self, residual: Tensor) -> float:
        """Return E, as a mean over pixels and channels."""
        return float((residual * self.apply(residual)).mean())

    def weigh(self, means: Tensor, cholesky: Tensor) -> Tensor:
        """Return about what the squared error of Gaussians counts in E, by their places and sizes, (N,)."""
        l11, l21, l22 = cholesky.detach().unbind(-1)
        xx, xy, yy = l11**2, l11 * l21, l21**2 + l22**2
        x, y = means.detach().floor().long().unbind(-1)
        total = torch.zeros_like(xx)
        for level, mask in enumerate(self.masks):
            # an average over blocks is a convolution, which adds the block's variance, and loses as much energy
            added = (4**level - 1) / 12
            kept = l11 * l22 / ((xx + added) * (yy + added) - xy**2).sqrt()
            row, column = (
                (place >> level).clamp(0, length - 1) for place, length in zip((y, x), mask.shape, strict=True)
            )
            total += 0.25**level * mask[row, column] * kept
        return total


def _even(planes: Tensor) -> Tensor:
    """Leave out the last row and column where their number is odd."""
    return planes[:, : planes.shape[1] // 2 * 2, : planes.shape[2] // 2 * 2]
