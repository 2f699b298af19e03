"""The repr of public objects, one line, and their image in a notebook."""

from __future__ import annotations

import dataclasses
import io
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:  # the command line reads the zoo without torch
    from torch import Tensor

T = TypeVar("T")

# characters of one field, and of a whole repr
_FIELD_LENGTH = 60
_LINE_LENGTH = 200


def brief(kind: type[T]) -> type[T]:
    """Give a NamedTuple or a dataclass a repr of one line, with the sizes of tensors, bytes and long lists."""
    kind.__repr__ = _describe  # type: ignore[method-assign]
    return kind


def _describe(value: Any) -> str:
    names = getattr(value, "_fields", None) or [field.name for field in dataclasses.fields(value)]
    fields = ", ".join(f"{name}={_short(getattr(value, name))}" for name in names)
    return shorten(f"{type(value).__name__}({fields})")


def _short(value: Any) -> str:
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    if isinstance(value, bytes):
        return f"{len(value):,} bytes"
    if type(value) in (list, tuple, dict) and len(value) > 4:
        return f"{len(value)} entries"
    return shorten(repr(value), _FIELD_LENGTH)


def shorten(text: str, length: int = _LINE_LENGTH) -> str:
    """Put a text into a line of at most so many characters."""
    text = " ".join(text[: 2 * length].split())
    return text if len(text) <= length else f"{text[: length - 4]}...{text[-1] if text[-1] in ')]}' else ''}"


def png(image: Tensor) -> bytes | None:
    """Return the PNG of an image (C, H, W) in [0, 1]; None if it is not grey, RGB or RGBA."""
    from PIL import Image

    if image.ndim != 3 or image.shape[0] not in (1, 3, 4):
        return None
    levels = (image.float() * 255).round().byte().permute(1, 2, 0).squeeze(-1).cpu().numpy()
    Image.fromarray(levels).save(file := io.BytesIO(), "PNG")
    return file.getvalue()
