"""Conversion of images, be they tensors, numpy arrays, PIL images or files, to one tensor."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_floating, check_image, is_pil
from kcgs._rows import row_slices
from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument, InvalidArgumentType

# Rec. 601
LUMA = (0.299, 0.587, 0.114)


def as_image(
    name: str, value: object, tolerance: float = 0.0, keep_alpha: bool = False, keep_batch: bool = False
) -> Tensor:
    """Return an image as a tensor (C, H, W) in [0, 1]; values may exceed this range by `tolerance`.

    An image is a Tensor (C, H, W) or (1, C, H, W), whose channels are taken as they are; a numpy array (H, W, C) or
    (H, W) of uint8, uint16 or floats in [0, 1]; a PIL image; or a path, as `kcgs.data.load_image` reads it. Arrays of
    four channels and PIL images with alpha are composed on white, with a warning where a pixel is transparent, unless
    `keep_alpha`. A Tensor that looks like (H, W, C) is refused: more than 4 channels and rows, and 1, 3 or 4 columns.
    With `keep_batch` a Tensor may be a batch (B, C, H, W), and stays one.
    """
    has_alpha = False
    if isinstance(value, np.ndarray):
        image = _from_array(name, value)
        has_alpha = len(image) == 4
    elif is_pil(value):
        from kcgs._decode import pil_samples

        image = _from_array(name, pil_samples(value))
        has_alpha = len(image) in (2, 4)
    elif isinstance(value, Tensor):
        if value.dtype == torch.uint8:
            raise InvalidArgumentType(name, "floating, in [0, 1]", f"{value.dtype}: pass {name} / 255")
        image = check_floating(name, value, dims=(3, 4), finite=False)  # checked below
    elif isinstance(value, str | os.PathLike):
        return read_image(value)
    else:
        expected = "a Tensor, a numpy array, a PIL image or a path"
        raise InvalidArgumentType(name, expected, type(value).__name__)
    if image.ndim == 4 and not keep_batch:
        if image.shape[0] != 1:
            raise InvalidArgument(name, "one image, (C, H, W) or (1, C, H, W)", tuple(image.shape))
        image = image[0]
    low, high = (float(end) for end in image.detach().aminmax()) if image.numel() else (math.nan, math.nan)
    if not (math.isfinite(low) and math.isfinite(high)):
        check_image(name, image.detach().cpu())  # raises: not finite, or empty
    if image.shape[-1] in (1, 3, 4) and min(image.shape[-3:-1]) > 4:
        layouts, advice = ("(C, H, W)", "(H, W, C)"), f"pass {name}.permute(2, 0, 1), or a numpy array (H, W, C)"
        if image.ndim == 4:
            layouts, advice = ("(B, C, H, W)", "(B, H, W, C)"), f"pass {name}.permute(0, 3, 1, 2)"
        raise InvalidArgument(name, layouts[0], f"{tuple(image.shape)}, which looks like {layouts[1]}: {advice}")
    if low < -tolerance or high > 1 + tolerance:
        raise InvalidArgument(name, "in [0, 1]", f"[{low:g}, {high:g}]{_scale_hint(image)}")
    if not has_alpha or keep_alpha:
        return image
    if image[-1].min() < 1:
        _warn_of_alpha(name)
    return torch.from_numpy(_on_white(image.numpy()))


def _scale_hint(image: Tensor) -> str:
    """Return what to do with an image whose values are above 1: levels of 8 bits are whole numbers."""
    low, high = (float(end) for end in image.detach().aminmax())
    if low < 0:
        return ""
    is_8_bit = high <= 255 and bool((image.detach() % 1 == 0).all())
    return ": divide it by 255" if is_8_bit else f": divide it by {high:g}, or clip it"


def _from_array(name: str, array: NDArray[Any]) -> Tensor:
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[-1] > 4:
        raise InvalidArgument(name, "an array (H, W) or (H, W, C) with 1 to 4 channels", f"shape {array.shape}")
    if array.dtype in (np.uint8, np.uint16):
        return torch.from_numpy(_planes(array, np.iinfo(array.dtype).max))
    if array.dtype not in (np.float32, np.float64):
        raise InvalidArgumentType(name, "uint8, uint16, float32 or float64", array.dtype, verb="hold")
    return torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))


def read_image(path: str | os.PathLike[str], channels: str = "RGB") -> Tensor:
    """Read an image, as `kcgs.data.load_image` documents it."""
    from kcgs._decode import decode

    samples = decode(path)
    if samples.white is None:
        raise ValueError(f"cannot read {path}: {samples.values.dtype} samples have no stated white")
    if samples.frames > 1:
        warn_user(f"{path} holds {samples.frames} images: the first is read")
    values, white = samples.values, samples.white
    if values.dtype.kind == "f":
        values = np.require(values, np.float32, ["C", "W"])  # Pillow's arrays are read-only
        as_image(str(path), torch.from_numpy(values.transpose(2, 0, 1)))
    if channels != "RGBA" and values.shape[-1] in (2, 4) and values[..., -1].min() < white:
        _warn_of_alpha(str(path))
    image = np.empty((len(channels), *values.shape[:2]), np.float32)
    for rows in row_slices(*values.shape[:2]):
        image[:, rows] = _with_channels(_planes(values[rows], white), channels)
    return torch.from_numpy(image)


def _planes(values: NDArray[Any], white: float) -> NDArray[Any]:
    """Return samples (H, W, C) as (C, H, W) float32, divided by the value of full intensity."""
    height, width, channels = values.shape
    planes = np.empty((channels, height, width), np.float32)
    np.divide(values.transpose(2, 0, 1), white, out=planes, dtype=np.float32)
    return planes


def _with_channels(image: NDArray[Any], channels: str) -> NDArray[Any]:
    """Return an image of 1 to 4 channels as "RGB", "L" or "RGBA"; as "RGB", grey keeps its one channel."""
    if channels == "RGBA":
        color, alpha = (image[:-1], image[-1:]) if len(image) in (2, 4) else (image, np.ones_like(image[:1]))
        return np.concatenate([np.broadcast_to(color, (3, *color.shape[1:])), alpha])
    image = _on_white(image)
    if channels == "RGB" or len(image) == 1:
        return image
    red, green, blue = image * np.array(LUMA, np.float32)[:, None, None]
    luma: NDArray[Any] = (red + green + blue)[None].clip(0, 1)
    return luma


def _warn_of_alpha(name: str) -> None:
    warn_user(f"{name} has transparent pixels: they are composed on white")


def _on_white(image: NDArray[Any]) -> NDArray[Any]:
    """Compose an image with alpha, (2, H, W) or (4, H, W), on white; return other images unchanged."""
    if len(image) not in (2, 4):
        return image
    color, alpha = image[:-1], image[-1:]
    opaque: NDArray[Any] = (color * alpha + (1 - alpha)).clip(0, 1)
    return opaque
