"""Other codecs, as Pillow has them, at the settings that make the most of their bytes."""

from __future__ import annotations

from bisect import bisect_right
from functools import lru_cache
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, features
from torch import Tensor

from kcgs.functional import psnr


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
    pixels = (image * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
    size, qualities, files = (image.shape[2], image.shape[1]), CODECS[codec].qualities, []
    for variant in range(len(CODECS[codec].variants)):
        arguments = codec, variant, pixels.tobytes(), size
        index = bisect_right(qualities[1:], max_bytes, key=lambda quality: len(_encode(*arguments, quality)))
        files.append(_encode(*arguments, qualities[index]))
    small = [file for file in files if len(file) <= max_bytes]
    return max(small, key=lambda file: float(psnr(decode_file(file), image))) if small else min(files, key=len)


# searches for several sizes try the same qualities
@lru_cache(maxsize=256)
def _encode(codec: str, variant: int, pixels: bytes, size: tuple[int, int], quality: int) -> bytes:
    kind, file = CODECS[codec], BytesIO()
    image = Image.frombytes("RGB", size, pixels)
    image.save(file, kind.format, quality=quality, **kind.settings, **kind.variants[variant])
    return file.getvalue()
