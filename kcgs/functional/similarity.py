"""SSIM of large images in blocks, and its window: what SSIM, MS-SSIM and their objective share."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from .blur import blur, gaussian_taps

# Wang et al. 2004
SSIM_WINDOW = 11  # pixels
SSIM_SIGMA = 1.5  # pixels
K1 = 0.01  # of the luminance, as a share of the data range
K2 = 0.03  # of contrast and structure
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang et al. 2003, finest scale first
_MARGIN = SSIM_WINDOW // 2  # pixels
_BLOCK = 1 << 18  # pixels that are compared at a time: they stay in a processor's cache


def mean_ssim(image: Tensor, target: Tensor, *, contrast: bool = False, band: Tensor | None = None) -> Tensor:
    """Average SSIM, or contrast and structure alone, per channel, where the window lies inside, or over a band.

    Returns:
        (B, C) float64.
    """
    batch, channels, height, width = image.shape
    pixels: int | Tensor = (height - 2 * _MARGIN) * (width - 2 * _MARGIN)
    if band is not None:
        pixels = band.sum((1, 2, 3))[:, None]
        image, target = (pad(t, [_MARGIN] * 4, mode="reflect") for t in (image, target))
        band = band.expand(batch, channels, -1, -1).flatten(0, 1)
    # in a compiled graph, a loop over blocks would be thousands of nodes
    whole = torch.compiler.is_compiling()
    planes = batch * channels if whole else max(1, _BLOCK // (height * width))
    rows = image.shape[-2] if whole else max(8 * _MARGIN, _BLOCK // width)
    images, targets = (t.flatten(0, 1).split(planes) for t in (image, target))
    bands = [None] * len(images) if band is None else band.split(planes)
    sums = [_sum_ssim(*group, contrast, rows) for group in zip(images, targets, bands, strict=True)]
    return torch.cat(sums).reshape(batch, channels) / pixels


def _sum_ssim(image: Tensor, target: Tensor, band: Tensor | None, contrast: bool, rows: int) -> Tensor:
    """Add up the values of each plane (P, H, W), so many rows at a time; (P,) float64."""
    total = image.new_zeros(len(image), dtype=torch.float64)
    top, overhang = 0, image.new_empty((2, len(image), 0, image.shape[-1]))
    for block in zip(image.split(rows, -2), target.split(rows, -2), strict=True):
        # `split` and `cat`, since the gradient of each overlapping slice would be as large as the image
        window = torch.cat([overhang, torch.stack(block)], -2)
        values = _similarity(window[0], window[1], contrast)
        overhang, bottom = window[..., -2 * _MARGIN :, :], top + values.shape[-2]
        values = values if band is None else values * band[:, top:bottom]
        total, top = total + values.sum((1, 2), dtype=torch.float64), bottom
    return total


def _similarity(image: Tensor, target: Tensor, contrast: bool) -> Tensor:
    """Return SSIM, or its contrast and structure alone, where the window lies inside."""
    moments = window_mean(torch.stack([image, target, image * image, target * target, image * target]))
    squares, product = (moments[:2] * moments[:2]), moments[0] * moments[1]
    variances = (moments[2:4] - squares).clamp_min(0.0).sum(0)
    c1, c2 = K1**2, K2**2
    structure = (2 * (moments[4] - product) + c2) / (variances + c2)
    return structure if contrast else structure * (2 * product + c1) / (squares.sum(0) + c1)


def window_mean(maps: Tensor) -> Tensor:
    """Filter by the Gaussian window along both sides, without padding."""
    return blur(maps, window_taps())


def window_taps() -> list[float]:
    """Return half of the Gaussian window along one side, its centre first."""
    taps = gaussian_taps(SSIM_SIGMA, _MARGIN)
    total = sum([*taps[:0:-1], *taps])
    return [tap / total for tap in taps]
