"""Metrics of a scene against an image."""

from __future__ import annotations

import math
import warnings
from typing import Any

from kcgs._image import as_image
from kcgs.errors import InvalidArgument
from kcgs.functional import METRICS
from kcgs.maps import as_region_map
from kcgs.scene import Scene, check_scene


def evaluate(scene: Scene, image: Any, labels: Any = None, *, with_ssimulacra2: bool = True) -> dict[str, float]:
    r"""Render a scene, clipped to [0, 1], and compare it with an image.

    Args:
        scene: unbatched.
        image: of the scene's size and channels, as :func:`kcgs.fit` takes it.
        labels: the map with the contours for the edge-focused metrics, as :func:`kcgs.fit` takes it; None: the scene's
            map, whose contours a fit may have moved. The history of a fit and `kcgs fit` measure along the map of their
            input: pass that map for the same numbers.
        with_ssimulacra2: compute `ssimulacra2` too; it takes about 0.3 s for 480 x 854 pixels.

    Returns:
        The metrics by name: psnr (dB), ssim, ms_ssim, ef_psnr (dB) and ef_ssim within 5 pixels of the contours, and
        ssimulacra2. A metric that is not defined is NaN: MS-SSIM below 161 pixels per side, the edge-focused metrics
        without contours, SSIMULACRA2 without its package (`pip install ssimulacra2`).

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
    metrics = {}
    for name, metric in METRICS.items():
        if metric.is_optional and not with_ssimulacra2:
            continue
        if not metric.takes_labels:
            try:
                metrics[name] = float(metric.function(render, target))
            except ImportError:  # its package is missing
                metrics[name] = math.nan
        else:
            with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # a map of one region: no contours
                metrics[name] = math.nan if regions is None else float(metric.function(render, target, regions.labels))
    return metrics
