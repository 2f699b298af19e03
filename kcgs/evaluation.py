"""Metrics of a scene against an image."""

from __future__ import annotations

import math
import warnings
from io import BytesIO
from typing import Any

from torch import Tensor

from kcgs._image import as_image
from kcgs.errors import InvalidArgument
from kcgs.functional import ef_psnr, ef_ssim, ms_ssim, psnr, ssim
from kcgs.maps import as_region_map
from kcgs.scene import Scene, check_scene


def evaluate(scene: Scene, image: Any, labels: Any = None, *, with_ssimulacra2: bool = True) -> dict[str, float]:
    r"""Render a scene, clipped to [0, 1], and compare it with an image.

    Args:
        scene: unbatched.
        image: of the scene's size and channels, as :func:`kcgs.fit` takes it.
        labels: a map as :func:`kcgs.fit` takes it, with the contours of the edge-focused metrics; None: the scene's
            own, which a fit may have moved. The history of a fit and `kcgs fit` take the map of their input: pass it
            for the same numbers.
        with_ssimulacra2: whether :func:`ssimulacra2` is among the metrics; it takes about 0.3 s for 480 x 854.

    Returns:
        By name: psnr (dB), ssim, ms_ssim, within 5 pixels of the contours ef_psnr (dB) and ef_ssim, and ssimulacra2.
        A metric that is not defined is NaN: MS-SSIM below 161 pixels per side, the edge-focused metrics without
        contours, SSIMULACRA2 without its package, which `pip install ssimulacra2` brings.

    Raises:
        TypeError: arguments of the wrong type.
        ValueError: an image of another size or number of channels, a label map of another size.

    Warns:
        RuntimeWarning: the image is too small for SSIM or MS-SSIM, which are NaN.

    Example:
        >>> import torch
        >>> from kcgs import GaussianField
        >>> scene = Scene(GaussianField.random(10, (161, 192), seed=0))
        >>> metrics = evaluate(scene, scene.render())
        >>> metrics["psnr"], round(metrics["ssim"], 4)
        (inf, 1.0)
    """
    render, target = check_scene(scene).render(), as_image("image", image)
    if tuple(target.shape) != tuple(render.shape):
        raise InvalidArgument("image", f"the scene's shape {tuple(render.shape)}", tuple(target.shape), verb="have")
    regions = scene.regions if labels is None else as_region_map(labels, "labels")
    target = target.to(render.device)
    metrics = {metric.__name__: float(metric(render, target)) for metric in (psnr, ssim, ms_ssim)}
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # a map of one region has no contours
        for metric in (ef_psnr, ef_ssim):
            metrics[metric.__name__] = math.nan if regions is None else float(metric(render, target, regions.labels))
    return {**metrics, "ssimulacra2": ssimulacra2(render, target)} if with_ssimulacra2 else metrics


def ssimulacra2(render: Tensor, image: Tensor) -> float:
    """Compare a render with an image, (C, H, W) both in [0, 1], by SSIMULACRA2 of their 8-bit values.

    Equal images have 100, images that look equal 90, high, medium and low quality 70, 50 and 30; it may be negative.
    NaN: the package is missing, a side is below 8 pixels, or the channels are neither grey nor RGB. Below 225 pixels
    per side it has fewer scales: compare only with images of that size.
    """
    try:
        from ssimulacra2 import compute_ssimulacra2
    except ImportError:
        return math.nan
    if image.shape[0] not in (1, 3) or min(image.shape[1:]) < 8:
        return math.nan
    return float(compute_ssimulacra2(_ppm(image), _ppm(render)))


def _ppm(image: Tensor) -> BytesIO:
    """Return an image as a PPM file in memory, the format that is fastest to write."""
    levels = (image.detach().float().clamp(0, 1) * 255).round().byte().expand(3, -1, -1).permute(1, 2, 0)
    return BytesIO(b"P6 %d %d 255\n" % (image.shape[2], image.shape[1]) + levels.cpu().contiguous().numpy().tobytes())
