"""Other codecs, as Pillow has them, at the settings that make the most of their bytes."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache, partial
from io import BytesIO
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, features
from torch import Tensor

from kcgs.functional import psnr, ssimulacra2

from .images import resize


class Codec(NamedTuple):
    """A format of Pillow, its qualities, its fixed settings, and variants of which the better is taken."""

    format: str
    qualities: range
    settings: dict[str, Any]
    variants: tuple[dict[str, Any], ...] = ({},)


_SAMPLINGS = ({"subsampling": "4:2:0"}, {"subsampling": "4:4:4"})
_AVIF = {"speed": 4, "max_threads": 1}
CODECS = {
    "JPEG": Codec("JPEG", range(96), {"optimize": True, "progressive": True}, _SAMPLINGS),
    "WebP": Codec("WEBP", range(101), {"method": 6}),
    "AVIF": Codec("AVIF", range(101), _AVIF),
    # by default libaom optimizes other measures than PSNR; for PSNR, 4:4:4 may be better
    "AVIF, tune=psnr": Codec("AVIF", range(101), {**_AVIF, "advanced": {"tune": "psnr"}}, _SAMPLINGS),
}


class ReducedFile(NamedTuple):
    """A file of an image that may be reduced, and what is shown of it."""

    name: str  # of the codec, and the reduction
    data: bytes
    render: Tensor  # (3, H, W), of the image's size


def available_codecs() -> list[str]:
    """Name the codecs that this machine's Pillow has."""
    pillow_names = {"JPEG": "jpg", "WEBP": "webp", "AVIF": "avif"}
    return [name for name, codec in CODECS.items() if features.check(pillow_names[codec.format])]


def decode_file(data: bytes) -> Tensor:
    """Decode a file to (3, H, W) in [0, 1]."""
    with Image.open(BytesIO(data)) as file:
        pixels = np.asarray(file.convert("RGB"))
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255


def largest_file(codec: str, image: Tensor, max_bytes: int) -> bytes:
    """Make the largest file of at most `max_bytes`, or the smallest; of variants, the one with the higher PSNR."""
    pixels = _pixels(image)
    size, qualities, files = (image.shape[2], image.shape[1]), CODECS[codec].qualities, []
    for variant in range(len(CODECS[codec].variants)):
        arguments = codec, variant, pixels.tobytes(), size
        encode = partial(_encode, *arguments)
        # most reductions have no file as small: the first one says so
        candidates = qualities[1:] if len(encode(qualities[0])) <= max_bytes else range(0)
        index = bisect_right(candidates, max_bytes, key=lambda quality: len(encode(quality)))
        files.append(encode(qualities[index]))
    small = [file for file in files if len(file) <= max_bytes]
    return max(small, key=lambda file: float(psnr(decode_file(file), image))) if small else min(files, key=len)


def best_file(
    codecs: Sequence[str], image: Tensor, max_bytes: int, reductions: Sequence[int] = (1, 2, 3, 4)
) -> ReducedFile | None:
    """Make the file with the highest SSIMULACRA2 of at most `max_bytes`; None: no codec has one.

    It is of the image, or of the image whose sides are reduced so many times; that is enlarged bicubically.
    """
    files, size = [], (image.shape[1], image.shape[2])
    for codec, reduction in product(codecs, reductions):
        small_size = (round(size[0] / reduction), round(size[1] / reduction))
        small = image if reduction == 1 else resize(image, small_size, "lanczos")
        data = largest_file(codec, small, max_bytes)
        if len(data) <= max_bytes:
            name = codec if reduction == 1 else f"{codec} at 1/{reduction}"
            files.append(ReducedFile(name, data, resize(decode_file(data), size, "bicubic")))
    return max(files, key=lambda file: float(ssimulacra2(file.render, image)), default=None)


def _pixels(image: Tensor) -> np.ndarray:
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()


# searches for several sizes try the same qualities
@lru_cache(maxsize=256)
def _encode(codec: str, variant: int, pixels: bytes, size: tuple[int, int], quality: int) -> bytes:
    kind, file = CODECS[codec], BytesIO()
    image = Image.frombytes("RGB", size, pixels)
    image.save(file, kind.format, quality=quality, **kind.settings, **kind.variants[variant])
    return file.getvalue()
