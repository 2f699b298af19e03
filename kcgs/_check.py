"""Checks that public functions share; messages are built only when a check fails."""

from __future__ import annotations

import operator
from collections.abc import Sequence

import torch
from torch import Tensor

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16, torch.uint32)


def check_tensor(name: str, value: object) -> Tensor:
    """Return `value` if it is a dense tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a Tensor; got {type(value).__name__}")
    if value.layout != torch.strided or value.is_quantized:
        raise TypeError(f"{name} must be a dense tensor; got layout {value.layout}")
    return value


def check_floating(
    name: str, value: object, last: int | None = None, dims: Sequence[int] = (), finite: bool = True
) -> Tensor:
    """Return `value` if it is a real floating tensor of an allowed rank and last dimension, and finite if asked."""
    tensor = check_tensor(name, value)
    if tensor.dtype not in _FLOATS:
        raise TypeError(f"{name} must have a real floating dtype; got {tensor.dtype}")
    if dims and tensor.ndim not in dims:
        raise ValueError(f"{name} must have {' or '.join(map(str, dims))} dimensions; got shape {tuple(tensor.shape)}")
    if last is not None and (tensor.ndim == 0 or tensor.shape[-1] != last):
        raise ValueError(f"{name} must have shape (..., {last}); got {tuple(tensor.shape)}")
    if finite and not torch.isfinite(tensor).all():
        raise ValueError(f"{name} must be finite; got {int((~torch.isfinite(tensor)).sum())} NaN or infinite values")
    return tensor


def check_integer(name: str, value: object, dims: Sequence[int] = ()) -> Tensor:
    """Return `value` if it is an integer tensor of an allowed rank."""
    tensor = check_tensor(name, value)
    if tensor.dtype not in _INTEGERS:
        raise TypeError(f"{name} must have an integer dtype; got {tensor.dtype}")
    if dims and tensor.ndim not in dims:
        raise ValueError(f"{name} must have {' or '.join(map(str, dims))} dimensions; got shape {tuple(tensor.shape)}")
    return tensor


def check_ids(name: str, value: object, like: Tensor) -> Tensor:
    """Return region ids as int64: integer, one for each centre of `like` (..., 2), on its device, none negative."""
    tensor = check_integer(name, value)
    if tensor.shape != like.shape[:-1]:
        raise ValueError(f"{name} must have shape {tuple(like.shape[:-1])}; got {tuple(tensor.shape)}")
    if tensor.device != like.device:
        raise ValueError(f"{name} must be on {like.device} with means; got {tensor.device}")
    tensor = tensor.long()
    if tensor.numel() and int(tensor.min()) < 0:
        raise ValueError(f"{name} must be non-negative; got {int(tensor.min())}")
    return tensor


def check_cutoff(value: object) -> float:
    """Return the cutoff if it is a number in [0, 1)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"cutoff must be a number in [0, 1); got {value!r}")
    if not 0.0 <= value < 1.0:
        raise ValueError(f"cutoff must be in [0, 1); got {value!r}")
    return float(value)


def check_labels(name: str, value: object) -> Tensor:
    """Return a label map as int64: integer, (H, W) or (B, H, W), at least one pixel, no negative id."""
    tensor = check_integer(name, value, dims=(2, 3))
    if tensor.numel() == 0:
        raise ValueError(f"{name} must have at least one pixel; got shape {tuple(tensor.shape)}")
    tensor = tensor.long()
    if int(tensor.min()) < 0:
        raise ValueError(f"{name} must hold non-negative ids; got {int(tensor.min())}")
    return tensor


def check_size(name: str, value: object) -> tuple[int, int]:
    """Return (height, width) if both are whole numbers of at least 1."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise TypeError(f"{name} must be a pair (height, width); got {value!r}")
    height, width = value
    if any(isinstance(n, bool) or not hasattr(n, "__index__") for n in value):
        raise TypeError(f"{name} must hold two integers (height, width); got {value!r}")
    height, width = operator.index(height), operator.index(width)
    if height < 1 or width < 1:
        raise ValueError(f"{name} must be at least 1 x 1; got {value!r}")
    return height, width


def check_image(name: str, value: object) -> Tensor:
    """Return a finite floating image (C, H, W) or (B, C, H, W) with no empty dimension."""
    tensor = check_floating(name, value, dims=(3, 4))
    if tensor.numel() == 0:
        raise ValueError(f"{name} must not be empty; got shape {tuple(tensor.shape)}")
    return tensor
