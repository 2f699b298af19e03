"""Checks of arguments that public functions share; a message is built only when its check fails."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from kcgs._torch_internals import assert_async, unwrapped
from kcgs.errors import InvalidArgument, InvalidArgumentType

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16, torch.uint32)
# Python's whole numbers, and sizes that a graph leaves open
_WHOLE = int, torch.SymInt


def is_pil(value: object) -> bool:
    """Return whether a value is an image of Pillow, which need not be imported for this."""
    return hasattr(value, "getbands") and hasattr(value, "convert")


def check_tensor(name: str, value: object, dims: Sequence[int] = ()) -> Tensor:
    """Return `value` if it is a dense tensor of an allowed rank."""
    if not isinstance(value, Tensor):
        raise InvalidArgumentType(name, "a Tensor", type(value).__name__)
    if value.layout != torch.strided or value.is_quantized:
        raise InvalidArgumentType(name, "a dense tensor", f"layout {value.layout}")
    if dims and value.ndim not in dims:
        allowed = f"{' or '.join(map(str, dims))} dimensions"
        raise InvalidArgument(name, allowed, f"shape {tuple(value.shape)}", verb="have")
    return value


def check_floating(
    name: str, value: object, last: int | None = None, dims: Sequence[int] = (), finite: bool = True
) -> Tensor:
    """Return `value` if it is a real floating tensor of an allowed rank and last dimension, and, if asked, finite."""
    tensor = check_tensor(name, value, dims)
    if tensor.dtype not in _FLOATS:
        raise InvalidArgumentType(name, "a real floating dtype", tensor.dtype, verb="have")
    if last is not None and (tensor.ndim == 0 or tensor.shape[-1] != last):
        raise InvalidArgument(name, f"shape (..., {last})", tuple(tensor.shape), verb="have")
    if finite and not verify(torch.isfinite(tensor).all(), f"{name} must be finite"):
        raise InvalidArgument(name, "finite", f"{int((~torch.isfinite(tensor)).sum())} NaN or infinite values")
    return tensor


def verify(condition: Tensor, message: str) -> bool:
    """Return whether `condition` is true; in a graph and on CUDA, assert it without a host sync, and return True."""
    try:
        assert_async(condition, message)
    except RuntimeError:
        inner = unwrapped(condition)
        # vmap has no rule for assertions, nor for reading the values that a message shows
        if inner is not condition and not inner.all():
            raise ValueError(message) from None
        return inner is not condition
    return True


def check_integer(name: str, value: object, dims: Sequence[int] = ()) -> Tensor:
    """Return `value` if it is an integer tensor of an allowed rank."""
    tensor = check_tensor(name, value, dims)
    if tensor.dtype not in _INTEGERS:
        raise InvalidArgumentType(name, "an integer dtype", tensor.dtype, verb="have")
    return tensor


def check_rows(name: str, value: Tensor, means: Tensor, last: int | str) -> None:
    """Check that a tensor has one row for each mean; `last` is the length of a row, or its letter."""
    if value.shape[:-1] != means.shape[:-1]:
        shape = ", ".join(map(str, (*means.shape[:-1], last)))
        raise InvalidArgument(name, f"shape ({shape})", tuple(value.shape), verb="have")
    if value.shape[-1] == 0:
        raise InvalidArgument(name, "at least one channel", f"shape {tuple(value.shape)}", verb="have")


def check_ids(name: str, value: object, means: Tensor, values: bool = True) -> Tensor:
    """Return region ids as int64 if they are integers, one for each mean; with `values`, none may be negative."""
    tensor = check_integer(name, value)
    if tensor.shape != means.shape[:-1]:
        raise InvalidArgument(name, f"shape {tuple(means.shape[:-1])}", tuple(tensor.shape), verb="have")
    if tensor.device != means.device:
        raise InvalidArgument(name, f"on {means.device} with means", tensor.device)
    tensor = tensor.long()
    if values and not verify((tensor >= 0).all(), f"{name} must be non-negative"):
        raise InvalidArgument(name, "non-negative", int(tensor.min()))
    return tensor


def check_count(name: str, value: object, least: int = 1, most: int | None = None) -> int:
    """Return `value` if it is an integer (not a bool) of at least `least` and at most `most`."""
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        raise InvalidArgumentType(name, "an integer", repr(value))
    count = operator.index(value)
    if count < least or (most is not None and count > most):
        allowed = f"at least {least}" if most is None else f"in [{least}, {most}]"
        raise InvalidArgument(name, allowed, count)
    return count


def check_number(
    name: str, value: object, low: float = -math.inf, high: float = math.inf, *, unit: str = "", above: bool = False
) -> float:
    """Return `value` if it is a finite number (not a bool) in [low, high]; with `above`, in (low, high]."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise InvalidArgumentType(name, f"a number{unit and ' of ' + unit}", repr(value))
    number = float(value)
    inside = low < number <= high if above else low <= number <= high
    if not (inside and math.isfinite(number)):
        raise InvalidArgument(name, f"{_range(low, high, above)}{unit and ' ' + unit}", repr(value))
    return number


def check_numbers(
    name: str, value: object, count: int, low: float = -math.inf, high: float = math.inf, *, above: bool = False
) -> tuple[float, ...]:
    """Return `value` if it is a sequence of `count` numbers, each as `check_number` takes it."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InvalidArgumentType(name, f"{count} numbers", repr(value))
    if len(value) != count:
        raise InvalidArgument(name, f"{count} numbers", repr(value))
    return tuple(check_number(name, number, low, high, above=above) for number in value)


def _range(low: float, high: float, above: bool) -> str:
    if high < math.inf:
        return f"in {'(' if above else '['}{low:g}, {high:g}]"
    if low == -math.inf:
        return "finite"
    return f"finite and {'above' if above else 'at least'} {low:g}"


def check_cutoff(value: object) -> float:
    """Return the cutoff if it is a number in [0, 1)."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise InvalidArgumentType("cutoff", "a number in [0, 1)", repr(value))
    if not 0.0 <= value < 1.0:
        raise InvalidArgument("cutoff", "in [0, 1)", repr(value))
    return float(value)


def check_size(name: str, value: object) -> tuple[int, int]:
    """Return (height, width) if both are whole numbers of at least 1."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise InvalidArgumentType(name, "a pair (height, width)", repr(value))
    # for a side that a graph leaves open, hasattr cannot be traced, and operator.index would make it a constant
    plain = [isinstance(side, _WHOLE) for side in value]
    integers = [known or hasattr(side, "__index__") for known, side in zip(plain, value, strict=True)]
    if not all(integers) or any(isinstance(side, bool) for side in value):
        raise InvalidArgumentType(name, "two integers (height, width)", repr(value), verb="hold")
    height, width = (side if known else operator.index(side) for known, side in zip(plain, value, strict=True))
    if height < 1 or width < 1:
        raise InvalidArgument(name, "at least 1 x 1", repr(value))
    return height, width


def check_image(name: str, value: object) -> Tensor:
    """Return a finite floating image (C, H, W) or (B, C, H, W) with no empty dimension."""
    tensor = check_floating(name, value, dims=(3, 4))
    if tensor.numel() == 0:
        raise InvalidArgument(name, "empty", f"shape {tuple(tensor.shape)}", verb="not be")
    return tensor
