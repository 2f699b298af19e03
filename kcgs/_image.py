"""Images as people have them, tensors, numpy arrays and PIL images, as one tensor."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_floating, check_image
from kcgs.errors import InvalidArgument, InvalidArgumentType


def as_image(name: str, value: object, tolerance: float = 0.0) -> Tensor:
    """Return an image as a tensor (C, H, W) in [0, 1], which its values may pass by `tolerance`.

    An image is a Tensor (C, H, W) or (1, C, H, W), a numpy array (H, W, C) or (H, W) of uint8, uint16 or floats in
    [0, 1], or a PIL image, whose palette is resolved and whose transparent pixels are composed on white. A Tensor that
    looks like (H, W, C) is refused: more than 4 channels and rows, and 1, 3 or 4 columns.
    """
    if isinstance(value, np.ndarray):
        image = _from_array(name, value)
    elif hasattr(value, "getbands") and hasattr(value, "convert"):  # PIL, which need not be imported for this
        image = on_white(_from_array(name, pil_samples(value)))
    elif isinstance(value, Tensor):
        image = check_floating(name, value, dims=(3, 4), finite=False)  # check_image does that below
    else:
        hint = ": read it with kcgs.data.load_image" if isinstance(value, str | os.PathLike) else ""
        raise InvalidArgumentType(name, "a Tensor, a numpy array or a PIL image", f"{type(value).__name__}{hint}")
    if image.ndim == 4:
        if image.shape[0] != 1:
            raise InvalidArgument(name, "one image, (C, H, W) or (1, C, H, W)", tuple(image.shape))
        image = image[0]
    check_image(name, image)
    if image.shape[-1] in (1, 3, 4) and min(image.shape[:2]) > 4:
        advice = f"pass {name}.permute(2, 0, 1), or a numpy array (H, W, C)"
        raise InvalidArgument(name, "(C, H, W)", f"{tuple(image.shape)}, which looks like (H, W, C): {advice}")
    low, high = float(image.detach().min()), float(image.detach().max())
    if low < -tolerance or high > 1 + tolerance:
        raise InvalidArgument(name, "in [0, 1]", f"[{low:g}, {high:g}]")
    return image


def _from_array(name: str, array: NDArray[Any]) -> Tensor:
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[-1] > 4:
        raise InvalidArgument(name, "an array (H, W) or (H, W, C) with 1 to 4 channels", f"shape {array.shape}")
    if array.dtype in (np.uint8, np.uint16):
        array = array.astype(np.float32) / np.float32(np.iinfo(array.dtype).max)
    elif array.dtype not in (np.float32, np.float64):
        raise InvalidArgumentType(name, "uint8, uint16, float32 or float64", array.dtype, verb="hold")
    return torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))


def pil_samples(image: Any) -> NDArray[Any]:
    """Return the pixels of a PIL image, (H, W, C): grey, grey and alpha, RGB or RGBA, of uint8, uint16 or float32."""
    if image.mode == "F":
        values = np.asarray(image)
    elif image.mode.startswith("I"):  # 16-bit grey, which Pillow has in 32 bits for some formats
        values = np.asarray(image).astype(np.uint16)
    else:
        mode = "L" if image.mode in ("1", "L") else "RGB"
        if image.has_transparency_data:
            mode = "LA" if image.mode in ("LA", "La") else "RGBA"
        values = np.asarray(image.convert(mode))
    return values if values.ndim == 3 else values[..., None]


def on_white(image: Tensor) -> Tensor:
    """Compose an image with alpha, (2, H, W) or (4, H, W), on white; return others as they are."""
    if len(image) not in (2, 4):
        return image
    color, alpha = image[:-1], image[-1:]
    return (color * alpha + (1 - alpha)).clamp(0, 1)
