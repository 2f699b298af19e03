"""How far an image is from another: PSNR, SSIM and MS-SSIM over the image, PSNR and SSIM along the contours."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from kcgs._check import check_image
from kcgs._labels import check_labels
from kcgs._warn import warn_user
from kcgs.maps import edge_band

from .blur import blur, gaussian_taps

# Wang et al. 2004
SSIM_WINDOW = 11  # pixels
SSIM_SIGMA = 1.5  # pixels
K1 = 0.01  # of the luminance, as a share of the data range
K2 = 0.03  # of contrast and structure
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang et al. 2003, finest scale first
_MARGIN = SSIM_WINDOW // 2  # pixels
_MS_SSIM_SIDE = (SSIM_WINDOW - 1) * 2 ** (len(SCALE_WEIGHTS) - 1) + 1  # pixels: the coarsest scale holds one window
_BLOCK = 1 << 18  # pixels that are compared at a time: they stay in a processor's cache


def psnr(image: Tensor, target: Tensor) -> Tensor:
    r"""Peak signal-to-noise ratio: :math:`-10 \log_{10}` of the mean squared error over pixels and channels.

    Convention, of all metrics: both are clipped to [0, 1], data range 1; one number per image. Half precision is
    computed and returned in float32; two dtypes meet in the wider one. Differentiable, except between identical images.

    Args:
        image: floating, :math:`(C, H, W)` or :math:`(B, C, H, W)`, any number of channels.
        target: same shape and device.

    Returns:
        dB, 0-dim or :math:`(B)`; infinite for identical images.

    Raises:
        TypeError: not floating tensors.
        ValueError: shapes or devices that differ, not 3 or 4 dimensions, no pixels, values that are not finite.

    Example:
        >>> psnr(torch.full((3, 8, 8), 0.6), torch.full((3, 8, 8), 0.5))
        tensor(20.0000)
    """
    image, target, batch_shape = _check_pair(image, target)
    mse = (image - target).square().flatten(1).mean(1)
    return -10.0 * torch.log10(mse.reshape(batch_shape))


def ssim(image: Tensor, target: Tensor) -> Tensor:
    r"""Structural similarity: 11 x 11 Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03.

    Convention: arguments, range and errors are those of :func:`psnr`; the mean over channels and over the positions
    where the window lies inside the image, without padding. Differentiable. Sums, not convolutions: variances are small
    differences, and the TF32 of CUDA's convolutions has too few digits for them (errors up to 0.03 on photographs).

    Returns:
        In [-1, 1], 0-dim or :math:`(B)`. NaN, with a RuntimeWarning, where a side is below 11 pixels.

    Example:
        >>> stripes = torch.arange(256.0).reshape(1, 16, 16) % 2
        >>> ssim(stripes, stripes).round(decimals=4), ssim(stripes, 1 - stripes).round(decimals=4)
        (tensor(1.), tensor(-0.9964))

    Source: Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural
    similarity", 2004.
    """
    image, target, batch_shape = _check_pair(image, target)
    if min(image.shape[-2:]) < SSIM_WINDOW:
        return _nan("ssim", image, batch_shape, SSIM_WINDOW)
    return _mean_ssim(image, target).mean(1).to(image.dtype).reshape(batch_shape)


def ms_ssim(image: Tensor, target: Tensor) -> Tensor:
    r"""Multi-scale structural similarity over 5 scales with the published weights.

    Convention: arguments, range and errors are those of :func:`psnr`, the window that of :func:`ssim`, without padding;
    channels apart, then averaged. A scale whose mean term is below zero counts as zero, since a fractional power of it
    does not exist; the gradient is not finite there. Between scales 2 x 2 pixels are averaged, and a last row or column
    without a partner with itself, as in the authors' program. pytorch-msssim pairs the first and last with black: the
    same where every halved side is even, else up to 0.004 away (measured at 201 x 333).

    Returns:
        In [0, 1], 0-dim or :math:`(B)`. NaN, with a RuntimeWarning, where a side is below 161 pixels.

    Example:
        >>> ramp = torch.linspace(0, 1, 161).expand(1, 161, 161)
        >>> ms_ssim(ramp, ramp).round(decimals=4), ms_ssim(ramp, 1 - ramp)
        (tensor(1.), tensor(0.))

    Source: Wang, Simoncelli, Bovik, "Multi-scale structural similarity for image quality assessment", 2003.
    """
    image, target, batch_shape = _check_pair(image, target)
    if min(image.shape[-2:]) < _MS_SSIM_SIDE:
        return _nan("ms_ssim", image, batch_shape, _MS_SSIM_SIDE)
    product = torch.ones((), dtype=torch.float64, device=image.device)
    for weight in SCALE_WEIGHTS[:-1]:
        product = product * _mean_ssim(image, target, contrast=True).relu() ** weight
        image, target = _halve(image), _halve(target)
    product = product * _mean_ssim(image, target).relu() ** SCALE_WEIGHTS[-1]
    return product.mean(1).to(image.dtype).reshape(batch_shape)


def ef_psnr(image: Tensor, target: Tensor, labels: Tensor, width: float = 5) -> Tensor:
    r"""Edge-focused PSNR: the mean squared error is taken over the band along the contours only.

    Convention: the range is that of :func:`psnr`, the band is :func:`edge_band`.

    Args:
        image: floating, :math:`(C, H, W)` or :math:`(B, C, H, W)`.
        target: same shape and device.
        labels: integer label map on the same device, :math:`(H, W)` for every image or :math:`(B, H, W)`.
        width: of the band on either side in pixels, at least 1.

    Returns:
        dB, 0-dim or :math:`(B)`; infinite where the band is identical. NaN, with a RuntimeWarning, where the
        label map has one region and so no band.

    Raises:
        TypeError, ValueError: as :func:`psnr` and :func:`edge_band`; labels of another size or device.

    Example:
        >>> labels = (torch.arange(20) >= 10).long().expand(20, 20)
        >>> black = torch.zeros(1, 20, 20)
        >>> image = black.index_fill(2, torch.tensor([0, 19]), 1.0)  # wrong far from the contour
        >>> psnr(image, black), ef_psnr(image, black, labels)
        (tensor(10.), tensor(inf))

    Source: the paper's edge-focused evaluation.
    """
    image, target, batch_shape = _check_pair(image, target)
    band = _check_band("ef_psnr", image, labels, width)
    # an empty band gives 0 / 0, the NaN of the warning
    error = ((image - target).square() * band).sum((1, 2, 3)) / (band.sum((1, 2, 3)) * image.shape[1])
    return -10.0 * torch.log10(error.reshape(batch_shape))


def ef_ssim(image: Tensor, target: Tensor, labels: Tensor, width: float = 5) -> Tensor:
    r"""Edge-focused SSIM: the mean of the SSIM map over the band along the contours only.

    Convention: arguments, band and errors are those of :func:`ef_psnr`, the window that of :func:`ssim`, and the map as
    large as the image, which is mirrored at its border for that (border pixel not repeated).

    Returns:
        In [-1, 1], 0-dim or :math:`(B)`. NaN, with a RuntimeWarning, where a side is below 11 pixels or the label map
        has one region and so no band.

    Example:
        >>> labels = (torch.arange(40) >= 20).long().expand(20, 40)
        >>> target = labels[None].float()
        >>> image = target.index_fill(2, torch.tensor([0, 39]), 0.5)  # wrong far from the contour
        >>> bool(ssim(image, target) < 0.99), ef_ssim(image, target, labels).round(decimals=4)
        (True, tensor(1.))

    Source: the paper's edge-focused evaluation.
    """
    image, target, batch_shape = _check_pair(image, target)
    band = _check_band("ef_ssim", image, labels, width)
    if min(image.shape[-2:]) < SSIM_WINDOW:
        return _nan("ef_ssim", image, batch_shape, SSIM_WINDOW)
    return _mean_ssim(image, target, band=band).mean(1).to(image.dtype).reshape(batch_shape)


def _check_pair(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor, torch.Size]:
    """Validate, clip and batch; return the shape of the result too, () or (B,)."""
    check_image("image", image)
    check_image("target", target)
    if target.shape != image.shape:
        raise ValueError(f"target must have the shape of image, {tuple(image.shape)}; got {tuple(target.shape)}")
    if target.device != image.device:
        raise ValueError(f"target must be on {image.device} with image; got {target.device}")
    dtype = torch.promote_types(torch.promote_types(image.dtype, target.dtype), torch.float32)
    batch_shape = image.shape[:-3]
    image, target = (t.to(dtype).clamp(0.0, 1.0).reshape(-1, *t.shape[-3:]) for t in (image, target))
    return image, target, batch_shape


def _check_band(name: str, image: Tensor, labels: Tensor, width: float) -> Tensor:
    """Validate the label map against a batched image and return its band, (B or 1, 1, H, W) bool."""
    labels = check_labels("labels", labels)
    if labels.device != image.device:
        raise ValueError(f"labels must be on {image.device} with image; got {labels.device}")
    batch, _, height, breadth = image.shape
    maps = labels.shape[0] if labels.ndim == 3 else 1
    if labels.shape[-2:] != (height, breadth) or maps not in (1, batch):
        raise ValueError(
            f"labels must have shape ({height}, {breadth}) or ({batch}, {height}, {breadth}) to fit image; got "
            f"{tuple(labels.shape)}"
        )
    band = edge_band(labels, width).reshape(maps, 1, height, breadth)
    empty = (~band.flatten(1).any(1)).sum()
    if not torch.compiler.is_compiling() and empty:
        which = "the label map has" if maps == 1 else f"{empty} of {maps} label maps have"
        warn_user(f"{name} is NaN: {which} one region and so no edge band", RuntimeWarning)
    return band


def _nan(name: str, image: Tensor, batch_shape: torch.Size, side: int) -> Tensor:
    """Return NaN for images smaller than a window of `side` pixels, and warn."""
    height, width = image.shape[-2:]
    warn_user(
        f"{name} is NaN: the image has {height} x {width} pixels, its window needs {side} x {side}",
        RuntimeWarning,
    )
    return image.new_full(batch_shape, math.nan)


def _halve(image: Tensor) -> Tensor:
    height, width = image.shape[-2:]
    return avg_pool2d(pad(image, (0, width % 2, 0, height % 2), mode="replicate"), 2)


def _mean_ssim(image: Tensor, target: Tensor, *, contrast: bool = False, band: Tensor | None = None) -> Tensor:
    """Mean SSIM of each channel, or contrast and structure alone, where the window lies inside, or over a band.

    Returns:
        (B, C) float64.
    """
    batch, channels, height, width = image.shape
    pixels: int | Tensor = (height - 2 * _MARGIN) * (width - 2 * _MARGIN)
    if band is not None:
        pixels = band.sum((1, 2, 3))[:, None]
        image, target = (pad(t, [_MARGIN] * 4, mode="reflect") for t in (image, target))
        band = band.expand(batch, channels, -1, -1).flatten(0, 1)
    # compiled, a loop over blocks would be a graph of thousands of nodes
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
        # `split` and `cat`, since the gradient of overlapping slices would be as large as the image for each
        window = torch.cat([overhang, torch.stack(block)], -2)
        values = _similarity(window[0], window[1], contrast)
        overhang, bottom = window[..., -2 * _MARGIN :, :], top + values.shape[-2]
        values = values if band is None else values * band[:, top:bottom]
        total, top = total + values.sum((1, 2), dtype=torch.float64), bottom
    return total


def _similarity(image: Tensor, target: Tensor, contrast: bool) -> Tensor:
    """SSIM, or its contrast and structure alone, where the window lies inside."""
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
