"""Conversion of label maps, be they tensors, numpy arrays, PIL images or files, to one tensor."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_integer, check_number, is_pil, verify
from kcgs._image import LUMA
from kcgs._rows import row_slices
from kcgs.errors import InvalidArgument, InvalidArgumentType

MAX_COLORS = 4096
"""An image with more distinct colours is taken for a photo, not for a label map."""

# a mask with soft edges is known by its grey levels: this share of their range at either end counts as dark or light
_END_SHARE = 1 / 16
# least share of pixels of such a mask that are dark or light
_MIN_SHARE = 0.5
# least number of levels of such a mask between dark and light
_MIN_LEVELS = 8
# of the pixels between dark and light, largest share whose eight neighbours have their own level
_MAX_INTERIOR = 0.05

# what to pass in place of a mask with soft edges, by a threshold
Remedy = Callable[[int], str]


def is_label_source(value: object) -> bool:
    """Return whether a value is of a type that `check_labels` reads."""
    return isinstance(value, Tensor | np.ndarray | str | os.PathLike) or is_pil(value)


def check_labels(name: str, value: object, dims: Sequence[int] = (2, 3), values: bool = True) -> Tensor:
    """Return a label map as int64; with `values`, no id may be negative.

    A map is a tensor or a numpy array, a PIL image, or a path: see `kcgs.data.load_labels`. Arrays hold integers, bool
    or floating whole numbers; (B, 1, H, W), as Kornia's augmentations return it, is returned as (B, H, W).
    """
    if isinstance(value, Tensor):
        value = _from_tensor(name, value)
    elif isinstance(value, np.ndarray):
        if values and value.ndim == 2:
            _check_edges(name, value, lambda level: f"np.asarray({name}) > {level}")
        if value.dtype.kind == "f":
            value = _from_tensor(name, torch.from_numpy(np.array(value, np.float64)))
        else:
            value = _from_array(name, value, values)
    elif isinstance(value, str | os.PathLike):
        value = read_labels(value)
    elif is_pil(value):
        value = _from_pil(name, value)
    else:
        raise InvalidArgumentType(name, "a Tensor, a numpy array, a PIL image or a path", type(value).__name__)
    if value.ndim == 4 and value.shape[1] == 1:
        value = value[:, 0]
    tensor = check_integer(name, value, dims=dims)
    if tensor.numel() == 0:
        raise InvalidArgument(name, "at least one pixel", f"shape {tuple(tensor.shape)}", verb="have")
    tensor = tensor.long()
    if values and not verify(tensor.min() >= 0, f"{name} must hold non-negative ids"):
        raise InvalidArgument(name, "non-negative ids", int(tensor.min()), verb="hold")
    return tensor


def _from_tensor(name: str, value: Tensor) -> Tensor:
    """Return integers as they are, and bool or floating whole numbers as int64."""
    if not value.is_floating_point():
        return value.long() if value.dtype == torch.bool else value
    # false for NaN and beyond int64; on CUDA, too, the host waits, since labels are prepared once
    is_whole = (value.detach() % 1 == 0) & (value.detach().abs() < 2.0**63)
    if value.is_cpu or torch.compiler.is_compiling():
        is_valid = verify(is_whole.all(), f"{name} must hold whole numbers")
    else:
        is_valid = bool(is_whole.all())
    if not is_valid:
        raise InvalidArgument(name, "whole numbers", float(value[~is_whole][0]), verb="hold")
    return value.long()


def read_labels(path: str | os.PathLike[str], rgb_ids: bool = False, threshold: float | None = None) -> Tensor:
    """Read a label map, as `kcgs.data.load_labels` documents it."""
    if threshold is not None:
        check_number("threshold", threshold, 0)

    def remedy(value: int) -> str:
        return f"load_labels({os.fspath(path)!r}, threshold={value}), or --threshold {value}"

    if Path(path).suffix.lower() == ".npy":
        try:
            values = np.asarray(np.load(path, allow_pickle=False))  # an archive becomes an object, which is no map
        except (ValueError, EOFError) as error:
            raise ValueError(f"cannot read {path} as an .npy array: {error}") from error
        return _from_grey(str(path), values, remedy, threshold)
    from kcgs._decode import decode

    samples = decode(path, indices=True)
    if not samples.lossless:
        raise InvalidArgument(
            "path",
            "a label map in a lossless format (PNG, TIFF, GIF, BMP, .npy)",
            f"{samples.format} at {path}, whose compression can change labels",
        )
    if rgb_ids and threshold is None and samples.values.shape[-1] > 1:
        return _from_ids(samples.values, path)
    return _from_samples(str(path), samples.values, remedy, threshold)


def _from_pil(name: str, image: Any) -> Tensor:
    from kcgs._decode import is_lossless, pil_indices

    if image.format is not None and not is_lossless(image):
        expected = "a label map from a lossless format (PNG, TIFF, GIF, BMP)"
        raise InvalidArgument(name, expected, f"{image.format}, whose compression can change labels")
    return _from_samples(name, pil_indices(image), lambda level: f"np.asarray({name}.convert('L')) > {level}")


def _from_samples(name: str, values: NDArray[Any], remedy: Remedy, threshold: float | None = None) -> Tensor:
    if values.shape[-1] == 1:
        return _from_grey(name, values[..., 0], remedy, threshold)
    luma = _luma(values)
    if threshold is not None:
        return torch.from_numpy(luma > threshold).long()
    _check_edges(name, luma, remedy)
    del luma
    return _from_colors(values, name)


def _luma(values: NDArray[Any]) -> NDArray[Any]:
    """Return the luma of samples (H, W, C) in their dtype, alpha left out."""
    if values.shape[-1] == 2:
        return values[..., 0]
    luma = np.empty(values.shape[:2], values.dtype)
    for rows in row_slices(*luma.shape):
        luma[rows] = (values[rows][..., :3] @ np.array(LUMA, np.float32)).round()
    return luma


def _from_grey(name: str, values: NDArray[Any], remedy: Remedy, threshold: float | None = None) -> Tensor:
    if threshold is not None:
        values = values > threshold
    _check_edges(name, values, remedy)
    return check_labels(name, _from_array(name, values, True, copy=False), dims=(2,))


def _from_array(name: str, array: NDArray[Any], values: bool, copy: bool = True) -> Tensor:
    if array.dtype.kind not in "biu":
        raise InvalidArgumentType(name, "an integer dtype", array.dtype, verb="have")
    if values and array.dtype == np.uint64 and array.size and array.max() >= 1 << 63:
        raise InvalidArgument(name, "ids below 2**63", array.max(), verb="hold")
    return torch.from_numpy((np.array if copy else np.asarray)(array, np.int64, order="C"))


def _from_ids(values: NDArray[Any], path: str | os.PathLike[str]) -> Tensor:
    if values.dtype != np.uint8 or values.shape[-1] != 3:
        samples = f"{values.shape[-1]} channels of {values.dtype}"
        raise ValueError(f"colours that are ids must be RGB of 8 bits; got {samples} in {path}")
    ids = values[..., 2].astype(np.int64, order="C")
    for channel in (1, 0):
        ids <<= 8
        ids |= values[..., channel]
    return torch.from_numpy(ids)


def _from_colors(values: NDArray[Any], path: str | os.PathLike[str]) -> Tensor:
    height, width = values.shape[:2]
    packed = np.empty((height, width), np.uint32 if values.dtype == np.uint8 else np.uint64)
    for rows in row_slices(height, width):
        packed[rows] = _pack(values[rows])
    colors = _sort_distinct(packed.ravel())
    del packed
    if len(colors) > MAX_COLORS:
        raise ValueError(
            f"label images must have at most {MAX_COLORS} distinct colours; got {len(colors)} in {path}, "
            "which looks like a photo, or a mask after lossy compression"
        )
    labels = np.empty((height, width), np.int64)
    for rows in row_slices(height, width):
        labels[rows] = np.searchsorted(colors, _pack(values[rows]))
    return torch.from_numpy(labels)


def _pack(values: NDArray[Any]) -> NDArray[Any]:
    """Return colours (H, W, C) as numbers in the order of R, then G, B and A; 0 for transparent colours."""
    bits, dtype = (8, np.uint32) if values.dtype == np.uint8 else (16, np.uint64)
    packed = np.zeros(values.shape[:2], dtype)
    for channel in range(values.shape[-1]):
        packed <<= bits
        packed |= values[..., channel].astype(dtype)
    if values.shape[-1] == 4:
        packed[values[..., 3] == 0] = 0
    return packed


def _sort_distinct(numbers: NDArray[Any]) -> NDArray[Any]:
    """Return the distinct numbers, sorted; `numbers` is sorted in place."""
    numbers.sort()
    return np.concatenate([numbers[:1], numbers[1:][numbers[1:] != numbers[:-1]]])


def _check_edges(name: str, levels: NDArray[Any], remedy: Remedy) -> None:
    """Refuse a mask with soft edges: levels between dark and light that occur along contours only.

    Args:
        name: of the map.
        levels: (H, W).
        remedy: says what to pass instead, by a threshold.
    """
    if levels.size == 0 or levels.dtype not in (np.uint8, np.uint16):
        return
    ids = np.flatnonzero(np.bincount(levels.ravel()))
    low, high = int(ids[0]), int(ids[-1])
    darkest, lightest = low + _END_SHARE * (high - low), high - _END_SHARE * (high - low)
    if ((ids > darkest) & (ids < lightest)).sum() < _MIN_LEVELS:
        return
    between = (levels > darkest) & (levels < lightest)
    if between.sum() > (1 - _MIN_SHARE) * levels.size:
        return
    from scipy.ndimage import maximum_filter, minimum_filter

    interior = (minimum_filter(levels, 3) == maximum_filter(levels, 3)) & between
    if interior.sum() <= _MAX_INTERIOR * between.sum():
        received = f"{len(ids)} grey levels, as a mask with soft edges has: pass {remedy((low + high) // 2)}"
        raise InvalidArgument(name, "ids of regions", received, verb="hold")
