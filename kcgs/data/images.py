"""Images on disk."""

import math
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs._image import as_image, read_image
from kcgs._suffixes import WRITTEN_IMAGES
from kcgs.errors import InvalidArgument

_MODES = {1: "L", 3: "RGB", 4: "RGBA"}
# options of Pillow, by format
_OPTIONS: dict[str, dict[str, object]] = {
    "JPEG": {"quality": 95, "subsampling": 0},
    "WEBP": {"lossless": True, "exact": True},
}


def load_image(path: str | os.PathLike[str], *, channels: Literal["RGB", "L", "RGBA"] = "RGB") -> Tensor:
    """Read an image as a tensor.

    It reads PNG, JPEG, WebP, TIFF, GIF, BMP and other formats of Pillow, and the first of several frames. EXIF
    orientation is applied. PNG and TIFF keep 16 bits per channel; float TIFF must be in [0, 1]. CMYK becomes RGB by
    Pillow's simple formula; colour profiles are not applied. "RGB" and "L" compose transparent pixels on white.

    Args:
        path: the file.
        channels: channels of the result. "RGB" repeats grey three times; "L" is Rec. 601 luma, 0.299 R + 0.587 G +
            0.114 B; "RGBA" adds an alpha of 1 to opaque images.

    Returns:
        :math:`(C, H, W)` float32 in [0, 1], C = 3, 1 or 4.

    Raises:
        OSError: ``path`` does not exist, or is a folder.
        ValueError: the file is truncated or no image, has more than twice ``PIL.Image.MAX_IMAGE_PIXELS``, its samples
            have no defined white (32-bit integers, floats outside [0, 1]), or ``channels`` is another word.

    Warns:
        UserWarning: the file holds several images; it has transparent pixels, which are composed on white.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_image(f"{folder}/a.png", torch.full((3, 2, 5), 0.2))
        ...     image = load_image(f"{folder}/a.png")
        >>> tuple(image.shape), round(float(image.mean()), 3)
        ((3, 2, 5), 0.2)
    """
    if channels not in _MODES.values():
        raise InvalidArgument("channels", '"RGB", "L" or "RGBA"', repr(channels))
    return read_image(path, channels)


def save_image(path: str | os.PathLike[str], image: Any) -> None:
    """Write an image with 8 bits per channel, atomically.

    Values are clipped to [0, 1] and rounded to the nearest of 256 levels. The suffix picks the format: .png, .webp,
    .tif, .tiff and .bmp keep the levels exactly, .jpg and .jpeg are quality 95 without chroma subsampling.

    Args:
        path: the file to write; its folder must exist.
        image: :math:`(C, H, W)` floating, C = 1 (grey), 3 (RGB) or 4 (RGBA, not for JPEG and BMP); or a numpy array (H,
            W, C), or a PIL image.

    Raises:
        FileNotFoundError: the folder of ``path`` does not exist.
        TypeError: ``image`` is no image.
        ValueError: ``image`` has another shape or non-finite values, or the suffix names no format for it.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_image(f"{folder}/a.png", torch.tensor([[[-1.0, 0.5, 2.0]]]))
        ...     (load_image(f"{folder}/a.png", channels="L") * 255).round().tolist()
        [[[0.0, 128.0, 255.0]]]
    """
    image = as_image("image", image, tolerance=math.inf, keep_alpha=True)
    if image.shape[0] not in _MODES:
        raise InvalidArgument("image", "shape (1, H, W), (3, H, W) or (4, H, W)", tuple(image.shape), verb="have")
    suffix = Path(path).suffix.lower()
    if suffix not in WRITTEN_IMAGES:
        raise ValueError(f"path must end in {', '.join(WRITTEN_IMAGES)}; got {str(path)!r}")
    kind = Image.registered_extensions()[suffix]
    if image.shape[0] == 4 and kind in ("JPEG", "BMP"):
        raise ValueError(f"path must end in .png, .webp or .tif to hold alpha; got {str(path)!r}")
    levels = (image.detach().float().clamp(0, 1) * 255 + 0.5).floor().to(torch.uint8)
    pixels = levels.permute(1, 2, 0).cpu().numpy()
    stored = Image.fromarray(np.ascontiguousarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels))
    with atomic_path(path) as temporary:
        stored.save(temporary, format=kind, **_OPTIONS.get(kind, {}))
