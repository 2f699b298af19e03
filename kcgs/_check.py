"""Checks that public functions share; messages are built only when a check fails."""

from __future__ import annotations

import math
import operator
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.errors import InvalidArgument, InvalidArgumentType

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16, torch.uint32)
# bytes that every machine has
_LITTLE = 1 << 26


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
    """Return `value` if it is a real floating tensor of an allowed rank and last dimension, and finite if asked."""
    tensor = check_tensor(name, value, dims)
    if tensor.dtype not in _FLOATS:
        raise InvalidArgumentType(name, "a real floating dtype", tensor.dtype, verb="have")
    if last is not None and (tensor.ndim == 0 or tensor.shape[-1] != last):
        raise InvalidArgument(name, f"shape (..., {last})", tuple(tensor.shape), verb="have")
    if finite and not holds(torch.isfinite(tensor).all(), f"{name} must be finite"):
        raise InvalidArgument(name, "finite", f"{int((~torch.isfinite(tensor)).sum())} NaN or infinite values")
    return tensor


def holds(condition: Tensor, words: str) -> bool:
    """Read a condition on values; in a graph and on CUDA it is an assertion instead, for which nobody waits."""
    try:
        torch._assert_async(condition, words)
    except RuntimeError:
        inner = condition
        while torch._C._functorch.is_functorch_wrapped_tensor(inner):  # vmap has no rule for assertions
            inner = torch._C._functorch.get_unwrapped(inner)
        if inner is not condition and not inner.all():  # nor for a message that shows values
            raise ValueError(words) from None
        return inner is not condition
    return True


def check_integer(name: str, value: object, dims: Sequence[int] = ()) -> Tensor:
    """Return `value` if it is an integer tensor of an allowed rank."""
    tensor = check_tensor(name, value, dims)
    if tensor.dtype not in _INTEGERS:
        raise InvalidArgumentType(name, "an integer dtype", tensor.dtype, verb="have")
    return tensor


def check_rows(name: str, value: Tensor, like: Tensor, last: int | str) -> None:
    """Refuse what has not one row for each of `like`; `last` is the length of a row, or its letter."""
    if value.shape[:-1] != like.shape[:-1]:
        wanted = ", ".join(map(str, (*like.shape[:-1], last)))
        raise InvalidArgument(name, f"shape ({wanted})", tuple(value.shape), verb="have")
    if value.shape[-1] == 0:
        raise InvalidArgument(name, "at least one channel", f"shape {tuple(value.shape)}", verb="have")


def check_ids(name: str, value: object, like: Tensor, values: bool = True) -> Tensor:
    """Return region ids as int64: integer, one for each centre of `like` (..., 2), with `values` none negative."""
    tensor = check_integer(name, value)
    if tensor.shape != like.shape[:-1]:
        raise InvalidArgument(name, f"shape {tuple(like.shape[:-1])}", tuple(tensor.shape), verb="have")
    if tensor.device != like.device:
        raise InvalidArgument(name, f"on {like.device} with means", tensor.device)
    tensor = tensor.long()
    if values and not holds((tensor >= 0).all(), f"{name} must be non-negative"):
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
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidArgumentType("cutoff", "a number in [0, 1)", repr(value))
    if not 0.0 <= value < 1.0:
        raise InvalidArgument("cutoff", "in [0, 1)", repr(value))
    return float(value)


def check_labels(name: str, value: object, dims: Sequence[int] = (2, 3), values: bool = True) -> Tensor:
    """Return a label map as int64: integer or bool, (H, W) or (B, H, W), at least one pixel; `values`: no negative id.

    A numpy array is one too; False is 0 and True is 1.
    """
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biu":
            raise InvalidArgumentType(name, "an integer dtype", value.dtype, verb="have")
        if values and value.dtype == np.uint64 and value.size and value.max() >= 1 << 63:
            raise InvalidArgument(name, "ids below 2**63", value.max(), verb="hold")
        value = torch.from_numpy(np.array(value, np.int64, order="C"))
    elif isinstance(value, Tensor) and value.dtype == torch.bool:
        value = value.long()
    tensor = check_integer(name, value, dims=dims)
    if tensor.numel() == 0:
        raise InvalidArgument(name, "at least one pixel", f"shape {tuple(tensor.shape)}", verb="have")
    tensor = tensor.long()
    if values and not holds(tensor.min() >= 0, f"{name} must hold non-negative ids"):
        raise InvalidArgument(name, "non-negative ids", int(tensor.min()), verb="hold")
    return tensor


def check_size(name: str, value: object) -> tuple[int, int]:
    """Return (height, width) if both are whole numbers of at least 1."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise InvalidArgumentType(name, "a pair (height, width)", repr(value))
    # operator.index would make a constant of the size that a graph leaves open
    whole = [isinstance(side, int | torch.SymInt) and not isinstance(side, bool) for side in value]
    if not all(known or hasattr(side, "__index__") for known, side in zip(whole, value, strict=True)):
        raise InvalidArgumentType(name, "two integers (height, width)", repr(value), verb="hold")
    height, width = (side if known else operator.index(side) for known, side in zip(whole, value, strict=True))
    if height < 1 or width < 1:
        raise InvalidArgument(name, "at least 1 x 1", repr(value))
    return height, width


def check_memory(name: str, size: tuple[int, int], per_pixel: float) -> None:
    """Refuse an image of so many pixels where it needs more memory than is free, at so many bytes per pixel."""
    needed = float(size[0]) * size[1] * per_pixel
    if needed > _LITTLE and needed > (free := _free_memory()):
        memory = f"about {needed / 1e9:,.1f} GB of memory; {free / 1e9:,.1f} GB are free"
        raise ValueError(f"{name} asks for {size[1]} x {size[0]} pixels, which need {memory}")


def _free_memory() -> float:
    """Bytes that this process may still take, swap included; infinite where the system does not say."""
    found = [math.inf]
    with suppress(OSError):
        facts = dict(re.findall(r"(\w+): +(\d+) kB", Path("/proc/meminfo").read_text()))
        found.append(1024.0 * sum(int(facts.get(name, 0)) for name in ("MemAvailable", "SwapFree")))
    for limit in ("memory.max", "memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):
            found.append(float(Path("/sys/fs/cgroup", limit).read_text()))
    if found == [math.inf]:
        with suppress(AttributeError, OSError, ValueError):
            found.append(float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")))
    return min(found)


def check_image(name: str, value: object) -> Tensor:
    """Return a finite floating image (C, H, W) or (B, C, H, W) with no empty dimension."""
    tensor = check_floating(name, value, dims=(3, 4))
    if tensor.numel() == 0:
        raise InvalidArgument(name, "empty", f"shape {tuple(tensor.shape)}", verb="not be")
    return tensor


def as_image(name: str, value: object, tolerance: float = 0.0) -> Tensor:
    """Return an image as one tensor (C, H, W) in [0, 1]: what a Tensor, an array or a PIL image shows.

    Taken are a Tensor (C, H, W) or (1, C, H, W), a numpy array (H, W, C) or (H, W) of uint8, uint16 or floats in [0,
    1], and a PIL image, whose palette is resolved and whose transparent pixels are composed on white.
    Values may pass [0, 1] by `tolerance`. A Tensor that can only be meant as (H, W, C) is refused: more than 4 channels
    and rows, and 1, 3 or 4 columns.
    """
    if isinstance(value, np.ndarray):
        image = _from_array(name, value)
    elif hasattr(value, "getbands") and hasattr(value, "convert"):  # PIL, which need not be imported for this
        image = on_white(_from_array(name, pil_samples(value)))
    elif isinstance(value, Tensor):
        image = check_floating(name, value, dims=(3, 4), finite=False)  # looked for below, once
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
    """Return what a PIL image shows, (H, W, C): grey, grey and alpha, RGB or RGBA, of uint8, uint16 or float32."""
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
