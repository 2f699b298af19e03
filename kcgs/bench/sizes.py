"""Sizes of scenes: real files, and what the parts of one are counted as where no file is made."""

from __future__ import annotations

from functools import lru_cache
from io import BytesIO

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcgs.codec import encode
from kcgs.functional import RegionMap
from kcgs.nn import GaussianField
from kcgs.rate import quality_for

GAUSSIAN_BYTES = 7


def write_scene(field: GaussianField, regions: RegionMap | None, psnr: float) -> bytes:
    """Write a scene, all that a decoder needs, as reports count it: without a look at the picture.

    Args:
        field: its Gaussians.
        regions: its map.
        psnr: of its picture, in dB.

    Example:
        >>> len(write_scene(GaussianField.random(100, (32, 48), seed=0), None, 30.0)) < 1000
        True
    """
    return encode(field, regions, quality=quality_for(psnr))


def map_bytes(labels: Tensor) -> int:
    """Size of a label map as lossless WebP.

    Args:
        labels: (H, W) integer; the ids themselves cost nothing.

    Example:
        >>> halves = (torch.arange(64) > 30).long().expand(64, 64)
        >>> 20 < map_bytes(halves) == map_bytes(7 * halves) < 100
        True
    """
    index = torch.unique(labels, return_inverse=True)[1].cpu().numpy().astype(np.int32)
    return _webp_bytes(index.tobytes(), index.shape[0])


def stored_bytes(regions: RegionMap | None) -> int:
    """Size of the map that a scene stores, the fine one where there is one; 0 without contours."""
    if regions is None:
        return 0
    return map_bytes(regions.fine_labels)


# a second's work, and most fits store the map that they were given
@lru_cache(maxsize=8)
def _webp_bytes(index: bytes, height: int) -> int:
    values = np.frombuffer(index, np.int32).reshape(height, -1)
    levels = np.stack([values >> 16, values >> 8, values], -1).astype(np.uint8)
    picture = Image.fromarray(levels if values.max() > 255 else levels[..., 2].copy())
    file = BytesIO()
    picture.save(file, "WEBP", lossless=True, quality=100, method=6)
    return file.getbuffer().nbytes
