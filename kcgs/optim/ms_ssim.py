"""The objective `ms-ssim`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from kcgs.functional import K1, K2, SCALE_WEIGHTS, SSIM_SIGMA, SSIM_WINDOW, halve, window_mean

from .gaussians import Gaussians
from .objectives import ImageObjective, Residual

if TYPE_CHECKING:
    from .ms_ssim_compiled import CompiledMsSsim

# weight of the squared error
_SQUARED = 0.003
# the same on a reduced photo, which has few Gaussians: with less weight, MS-SSIM adds stray strokes
_SQUARED_REDUCED = 0.03
# least mean score of a scale, since the logarithm has no bound at 0
_MIN_SCORE = 0.2


class _Scale(NamedTuple):
    """An image whose sides were halved k times, and what windows centred on its pixels see of it."""

    image: Tensor  # [..., C, h, w]
    inside: Tensor  # [1, h, w], inverse of the sum of a window's taps inside the image
    mean: Tensor  # [..., C, h, w]
    variance: Tensor  # [..., C, h, w]
    weight: float  # of a window


class _Band(NamedTuple):
    """A part of the quadratic form near the image: the energy that a first blur leaves and a second one removes."""

    octave: int  # the sides of `importance` were halved so often
    first: float  # variance of the first blur, in pixels of the image
    second: float
    importance: Tensor  # [..., h, w]


class MsSsim(ImageObjective):
    r"""The negative logarithm of MS-SSIM, and a little of the squared error.

    .. math:: E(r) = -\sum_k w_k \log \overline{s_k} / Z + 0.003 |r|^2, \quad
        1 - s_k = \frac{v(P_k r)}{v(P_k x) + v(P_k (x + r)) + 0.03^2}

    x is the image, r the render minus the image, :math:`P_k` averages blocks, v is the variance under the window of
    SSIM, and the last :math:`s_k` is multiplied by the luminance. Z is such that the weights of squared differences
    near the image, averaged over pixels, sum to 1 over the scales. Scales and weights are those of
    :func:`kcgs.functional.ms_ssim`, without the finest, which has a weight of 4 % and would take three quarters of the
    time. Windows overlap, so only those at even rows and columns count. Windows that the border cuts count as much as
    others, else the outer tenth of an image would count little. Near the image E is quadratic, and `importance` and
    `weigh` belong to that quadratic form. Farther from the image E is not: where texture is missing, more variance in
    the render is better, so `slope` is half the gradient of E itself.

    Args:
        image: (C, H, W) in [0, 1], or a batch of them.
        reduction: factor by which the sides of a photo were reduced to those of the image. The photo's scales keep
            their weights, so the finest scales are left out; the squared error has ten times the weight.

    Example:
        >>> image = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(0))
        >>> objective = MsSsim(image)
        >>> bool(objective.value(0.1 + 0.8 * image) < objective.value(torch.full_like(image, 0.5)))
        True
    """

    is_ranked_by_psnr = False

    def __init__(self, image: Tensor, reduction: int = 1) -> None:
        super().__init__(image)
        self._squared = _SQUARED if reduction == 1 else _SQUARED_REDUCED
        self._scales: list[_Scale] = []
        masks, plane = [], image
        for weight in SCALE_WEIGHTS[reduction.bit_length() :]:
            plane = halve(plane)
            if not plane.numel():
                break
            inside = 1.0 / _blur(image.new_ones(1, *plane.shape[-2:]))
            mean, square = (inside * _blur(t) for t in (plane, plane * plane))
            variance, weight = (square - mean * mean).clamp_min(0.0), weight / plane.shape[-2:].numel()
            self._scales.append(_Scale(plane, inside, mean, variance, weight))
            masks.append(_blur(inside * weight / (2.0 * variance + K2**2)).mean(-3))
        # Z of each image, in float64
        self._norm = image.new_zeros(image.shape[:-3], dtype=torch.float64)
        for mask in masks:
            self._norm += mask.mean((-2, -1))
        of_squared_error = torch.full_like(image[..., 0, :, :], self._squared)
        masks = [of_squared_error, *(mask / self._norm_of(mask) for mask in masks)]
        parts = [mask.unsqueeze(-3) * 0.25**octave for octave, mask in enumerate(masks)]
        self.importance = self._sum_up(parts).squeeze(-3)
        self._bands = [_Band(0, 0.0, math.inf, masks[0])]
        for octave, mask in enumerate(masks[1:], 1):
            # the mean under the window is no part of contrast and structure
            blocks, window = (4**octave - 1) / 12, SSIM_SIGMA**2 * 4**octave
            self._bands.append(_Band(octave, blocks, blocks + window, mask))
        if self._scales:
            _, inside, mean, _, weight = self._scales[-1]
            of_luminance = _blur(inside * weight / self._norm_of(mean) / (2.0 * mean * mean + K1**2)).mean(-3)
            self._bands.append(_Band(octave, blocks + window, math.inf, of_luminance))
        self._compiled: CompiledMsSsim | None = None
        if self._scales and image.device.type == "cpu" and image.dtype == torch.float32:
            from .ms_ssim_compiled import CompiledMsSsim  # loads numba

            factors = [scale.weight / self._norm * 0.25**octave for octave, scale in enumerate(self._scales, 1)]
            scales = [[plane.reshape(-1, *plane.shape[-2:]).numpy() for plane in planes] for *planes, _ in self._scales]
            table = torch.stack(factors).reshape(len(factors), -1).numpy()
            self._compiled = CompiledMsSsim(scales, table, _MIN_SCORE)  # the compiled form of `_measure`

    def _norm_of(self, planes: Tensor) -> Tensor:
        """Return Z of each image, in the shape and precision of planes."""
        lead = self._norm.shape
        return self._norm.view(*lead, *[1] * (planes.ndim - len(lead))).to(planes.dtype) if lead else self._norm

    def slope(self, render: Tensor) -> Tensor:
        """Return half the gradient of E.

        Where the mean of a scale is below 0.2, E takes it as 0.2, and the slope of its logarithm is 1 / 0.2.
        """
        return self._slope(render.sub_(self.image))

    def _slope(self, difference: Tensor) -> Tensor:
        if self._compiled is None:
            return self._measure(difference)[1]
        gradient = difference.contiguous()
        self._compiled.differentiate(gradient.view(-1, *gradient.shape[-2:]).numpy(), self._squared)
        return gradient

    def value(self, render: Tensor) -> Tensor:
        """Return E of a render, clipped to [0, 1], as a mean over pixels and channels, () or (B,) float64."""
        difference = render.clamp(0.0, 1.0) - self.image
        if self._compiled is None:
            total = self._measure(difference)[0].double()
        else:
            planes = difference.contiguous().view(-1, *difference.shape[-2:])
            total = torch.from_numpy(self._compiled.value(planes.numpy())).view(difference.shape[:-3])
        squared = difference.square().mean((-3, -2, -1)).double()
        return total / difference.shape[-2:].numel() + self._squared * squared

    def residual(self, render: Tensor) -> Residual:
        """Return the negative slope over the root of the importance; its square is what a Gaussian may gain."""
        root = self.importance.sqrt()
        return Residual(-self._slope(render - self.image) / root.unsqueeze(-3), root)

    def weigh(self, gaussians: Gaussians) -> Tensor:
        """Return about the weight of each Gaussian's squared error in E, by its place and size, (..., N)."""
        l11, l21, l22 = gaussians.cholesky.detach().unbind(-1)
        xx, xy, yy = l11**2, l11 * l21, l21**2 + l22**2
        x, y = gaussians.means.detach().floor().long().unbind(-1)
        total = torch.zeros_like(xx)

        def energy_after(variance: float) -> Tensor:
            """Return the share of a Gaussian's energy that is left after a blur of this variance."""
            return l11 * l22 / ((xx + variance) * (yy + variance) - xy**2).sqrt()

        for octave, first, second, importance in self._bands:
            height, width = importance.shape[-2:]
            pixels = (y >> octave).clamp(0, height - 1) * width + (x >> octave).clamp(0, width - 1)
            weight = importance.flatten(-2).gather(-1, pixels)
            total += 0.25**octave * weight * (energy_after(first) - energy_after(second))
        return total

    def _measure(self, difference: Tensor) -> tuple[Tensor, Tensor]:
        """Return E without the squared error, as a sum over pixels, and half the gradient of all of E."""
        total, gradients, plane = difference.new_zeros(difference.shape[:-3]), [self._squared * difference], difference
        for octave, (image, inside, mean, variance, weight) in enumerate(self._scales, 1):
            plane = halve(plane)
            render = image + plane
            # one blur after the other, so that each stays in a processor's cache
            render_mean, square, product = (inside * _blur(t) for t in (render, render * render, image * render))
            variances = (square - render_mean * render_mean).clamp_min_(0.0).add_(variance).add_(K2**2)
            structure = (product - mean * render_mean).mul_(2.0).add_(K2**2).div_(variances)
            luminance, luminance_slope = structure.new_ones(()), structure.new_zeros(())
            if octave == len(self._scales):
                means = mean * mean + render_mean * render_mean + K1**2
                luminance = (2.0 * mean * render_mean + K1**2) / means
                luminance_slope = structure * (luminance * render_mean - mean) / means
            windows = (structure * luminance)[..., ::2, ::2]
            score, area = windows.mean((-2, -1)).clamp_min(_MIN_SCORE), mean.shape[-2:].numel()
            total -= (weight / self._norm * area).to(total) * score.log().mean(-1)
            # windows at even rows and columns stand for all windows
            share = torch.zeros_like(plane)
            factor = (weight / self._norm * 0.25**octave * area / windows.shape[-2:].numel()).to(share)
            share[..., ::2, ::2] = inside[:, ::2, ::2] * factor.view(*factor.shape, 1, 1, 1) / score[..., None, None]
            by_product = share * luminance / variances
            by_square = by_product * structure
            by_mean = by_product * mean - by_square * render_mean + share * luminance_slope
            gradients.append(_blur(by_square) * render - _blur(by_product) * image + _blur(by_mean))
        return total, self._sum_up(gradients)

    @staticmethod
    def _sum_up(planes: list[Tensor]) -> Tensor:
        """Add to each pixel of the finest plane the values of its blocks in coarser planes; all planes change."""
        for fine, coarse in zip(planes[-2::-1], planes[:0:-1], strict=True):
            height, width = coarse.shape[-2:]
            blocks = fine[..., : 2 * height, : 2 * width].unflatten(-1, (width, 2)).unflatten(-3, (height, 2))
            blocks.add_(coarse[..., :, None, :, None])
        return planes[0]


def _blur(maps: Tensor) -> Tensor:
    """Filter by the window of SSIM, with zeros beyond the border; it is its own transpose."""
    return window_mean(pad(maps, [SSIM_WINDOW // 2] * 4))
