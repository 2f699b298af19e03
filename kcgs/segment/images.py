"""Images for segmenters: checked, and in CIE Lab."""

import math
from typing import Any

import numpy as np
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kcgs._image import as_image
from kcgs.errors import InvalidArgument
from kcgs.maps import Labels

# distance by which values may lie outside [0, 1], as after resizing or colour conversion
_TOLERANCE = 1e-3
# pixels that are converted to Lab at a time, since the conversion needs the memory of six images
_BLOCK = 1 << 16


def check_segment_image(image: Any) -> Tensor:
    """Return an image as (3, H, W) float32 in [0, 1], grey repeated, with the memory layout of (H, W, 3)."""
    tensor = as_image("image", image, tolerance=_TOLERANCE).detach()
    if tensor.shape[0] not in (1, 3):
        raise InvalidArgument("image", "shape (3, H, W) or (1, H, W)", tuple(tensor.shape), verb="have")
    return tensor.float().clamp(0, 1).expand(3, -1, -1).permute(1, 2, 0).contiguous().permute(2, 0, 1)


def to_pixels(image: Tensor) -> NDArray[np.float32]:
    """Return a checked image as (H, W, 3)."""
    return image.permute(1, 2, 0).cpu().numpy()


def reduce_image(image: Tensor, max_pixels: int) -> Tensor:
    """Return a checked image, reduced to at most `max_pixels`."""
    shrink = math.sqrt(image[0].numel() / max_pixels)
    if shrink <= 1:
        return image
    size = [max(1, round(side / shrink)) for side in image.shape[1:]]
    return check_segment_image(F.interpolate(image[None], size, mode="area")[0])


def rgb_to_lab(image: Tensor) -> NDArray[np.float32]:
    """Return a checked image (3, H, W) as CIE Lab (D65), (H, W, 3) with L in [0, 100]."""
    from skimage.color import rgb2lab

    parts = np.array_split(to_pixels(image), math.ceil(image[0].numel() / _BLOCK))
    return np.concatenate([rgb2lab(part) for part in parts if len(part)])


def lab_sums(lab: NDArray[np.float32], regions: Labels) -> NDArray[np.float64]:
    """Return the sum of the colours of every region, (R, 3)."""
    flat = regions.ravel()
    return np.stack([np.bincount(flat, weights=lab[..., k].ravel()) for k in range(3)], axis=1)
