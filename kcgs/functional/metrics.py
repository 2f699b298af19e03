"""The metrics between an image and its target, and the list of them that `evaluate` and the reports follow."""

from __future__ import annotations

import math
from collections.abc import Callable
from io import BytesIO
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from kcgs._check import check_image
from kcgs._labels import check_labels
from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument
from kcgs.maps import edge_band

from .similarity import SCALE_WEIGHTS, SSIM_WINDOW, mean_ssim

# least side for MS-SSIM, whose coarsest scale then holds one window
_MS_SSIM_SIDE = (SSIM_WINDOW - 1) * 2 ** (len(SCALE_WEIGHTS) - 1) + 1  # pixels


def psnr(image: Tensor, target: Tensor) -> Tensor:
    r"""Peak signal-to-noise ratio: :math:`-10 \log_{10}` of the mean squared error over pixels and channels.

    Convention, of all metrics: both images are clipped to [0, 1], the data range is 1; one number per image. Half
    precision is computed and returned in float32; of two dtypes the wider counts. Differentiable, except between
    identical images.

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

    Convention: arguments, range and errors are those of :func:`psnr`. The result is the mean over channels and over the
    positions where the window lies inside the image, without padding. Differentiable. Windows are sums, not
    convolutions: variances are small differences, and the TF32 of CUDA's convolutions has too few digits for them
    (errors up to 0.03 on photographs).

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
    return mean_ssim(image, target).mean(1).to(image.dtype).reshape(batch_shape)


def ms_ssim(image: Tensor, target: Tensor) -> Tensor:
    r"""Multi-scale structural similarity over 5 scales with the published weights.

    Convention: arguments, range and errors are those of :func:`psnr`, the window is that of :func:`ssim`, without
    padding. The result is the mean over channels. A scale whose mean term is below zero counts as zero, since a
    fractional power of it does not exist; the gradient is not finite there. Between scales, blocks of 2 x 2 pixels are
    averaged; an odd last row or column is repeated, as in the authors' program. pytorch-msssim pads odd sides with
    black: results are equal where every halved side is even, and else differ by up to 0.004 (measured at 201 x 333).

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
        product = product * mean_ssim(image, target, contrast=True).relu() ** weight
        image, target = _average_blocks(image), _average_blocks(target)
    product = product * mean_ssim(image, target).relu() ** SCALE_WEIGHTS[-1]
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

    Convention: arguments, band and errors are those of :func:`ef_psnr`, the window is that of :func:`ssim`. Images are
    mirrored at their border (border pixel not repeated), so that the map is as large as the image.

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
    return mean_ssim(image, target, band=band).mean(1).to(image.dtype).reshape(batch_shape)


def ssimulacra2(image: Tensor, target: Tensor) -> Tensor:
    r"""SSIMULACRA2 of the 8-bit values: how people judge an image that was compressed.

    Convention: arguments, range and errors are those of :func:`psnr`, and `target` is the original. Equal images have
    100, images that look equal 90, high, medium and low quality 70, 50 and 30; scores may be negative. Below 225 pixels
    per side it has fewer scales: compare only images of one size. Not differentiable; about 0.3 s for 480 x 854.

    Returns:
        float64, on the CPU, 0-dim or :math:`(B)`. NaN where a side is below 8 pixels, or the channels are neither grey
        nor RGB.

    Raises:
        ImportError: it needs `pip install ssimulacra2`.

    Example:
        >>> ssimulacra2(torch.zeros(3, 7, 9), torch.zeros(3, 7, 9))
        tensor(nan, dtype=torch.float64)

    Source: Sneyers, "SSIMULACRA2", 2023.
    """
    image, target, batch_shape = _check_pair(image, target)
    if image.shape[1] not in (1, 3) or min(image.shape[2:]) < 8:
        return torch.full(batch_shape, math.nan, dtype=torch.float64)
    try:
        from ssimulacra2 import compute_ssimulacra2
    except ImportError as error:
        raise ImportError("this metric needs the package ssimulacra2: pip install ssimulacra2") from error
    values = [compute_ssimulacra2(_ppm(t), _ppm(i)) for i, t in zip(image, target, strict=True)]
    return torch.tensor(values, dtype=torch.float64).reshape(batch_shape)


class Metric(NamedTuple):
    """A row of `METRICS`."""

    function: Callable[..., Tensor]
    """Takes an image and a target, as `psnr` does; with `takes_labels` also labels, as `ef_psnr` does."""
    undefined: str = ""
    """When the metric is NaN."""
    takes_labels: bool = False
    """Whether the metric is taken along contours."""
    is_optional: bool = False
    """Whether the metric is slow and needs another package: `evaluate` may leave it out."""


# what `evaluate` and the command line report, in this order
METRICS = {
    "psnr": Metric(psnr),
    "ssim": Metric(ssim, f"a side is below {SSIM_WINDOW} pixels"),
    "ms_ssim": Metric(ms_ssim, f"a side is below {_MS_SSIM_SIDE} pixels"),
    "ef_psnr": Metric(ef_psnr, "no contours", takes_labels=True),
    "ef_ssim": Metric(ef_ssim, f"no contours, or a side is below {SSIM_WINDOW} pixels", takes_labels=True),
    "ssimulacra2": Metric(ssimulacra2, "it needs pip install ssimulacra2, and 8 pixels per side", is_optional=True),
}


def _check_pair(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor, torch.Size]:
    """Validate, clip and batch; return the shape of the result too, () or (B,)."""
    check_image("image", image)
    check_image("target", target)
    if target.shape != image.shape:
        raise InvalidArgument("target", f"the shape of image, {tuple(image.shape)}", tuple(target.shape), verb="have")
    if target.device != image.device:
        raise InvalidArgument("target", f"on {image.device} with image", target.device)
    dtype = torch.promote_types(torch.promote_types(image.dtype, target.dtype), torch.float32)
    batch_shape = image.shape[:-3]
    image, target = (t.to(dtype).clamp(0.0, 1.0).reshape(-1, *t.shape[-3:]) for t in (image, target))
    return image, target, batch_shape


def _check_band(name: str, image: Tensor, labels: Tensor, width: float) -> Tensor:
    """Validate the label map against a batched image and return its band, (B or 1, 1, H, W) bool."""
    labels = check_labels("labels", labels)
    if labels.device != image.device:
        raise InvalidArgument("labels", f"on {image.device} with image", labels.device)
    batch, _, height, breadth = image.shape
    maps = labels.shape[0] if labels.ndim == 3 else 1
    if labels.shape[-2:] != (height, breadth) or maps not in (1, batch):
        raise InvalidArgument(
            "labels",
            f"shape ({height}, {breadth}) or ({batch}, {height}, {breadth}) to fit image",
            tuple(labels.shape),
            verb="have",
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


def _average_blocks(image: Tensor) -> Tensor:
    """Average blocks of 2 x 2 pixels; unlike `halve`, repeat an odd last row or column."""
    height, width = image.shape[-2:]
    return avg_pool2d(pad(image, (0, width % 2, 0, height % 2), mode="replicate"), 2)


def _ppm(image: Tensor) -> BytesIO:
    """Return an image (C, H, W) as a PPM file in memory, the format that is fastest to write."""
    levels = (image.detach().float() * 255).round().byte().expand(3, -1, -1).permute(1, 2, 0)
    return BytesIO(b"P6 %d %d 255\n" % (image.shape[2], image.shape[1]) + levels.cpu().contiguous().numpy().tobytes())
