"""The other codecs, as Pillow has them, at the settings that make the most of their bytes."""

from __future__ import annotations

import time
from bisect import bisect_right
from functools import lru_cache, partial
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, __version__, features
from torch import Tensor

from kcgs.functional import psnr

JPEG, WEBP, AVIF, AVIF_PSNR = "JPEG", "WebP", "AVIF", "AVIF, tune=psnr"
AVIF_FAST = f"{AVIF_PSNR}, speed 4"  # for groups of many files
# one quality for each of AVIF's 64 quantizers: the others give the same files
_AVIF_QUALITIES = tuple(sorted({((100 - q) * 63 + 50) // 100: q for q in range(101)}.values()))
_SUBSAMPLING = ({"subsampling": "4:2:0"}, {"subsampling": "4:4:4"})


class Codec(NamedTuple):
    """A codec: its settings that do not change, and those of which the better is taken."""

    format: str  # of Pillow
    feature: str  # that Pillow must have
    qualities: tuple[int, ...]  # rising
    settings: dict[str, Any]
    variants: tuple[dict[str, Any], ...] = ({},)


_AVIF = Codec("AVIF", "avif", _AVIF_QUALITIES, {"speed": 0, "max_threads": 1})
CODECS = {
    JPEG: Codec("JPEG", "jpg", tuple(range(96)), {"optimize": True, "progressive": True}, _SUBSAMPLING),
    WEBP: Codec("WEBP", "webp", tuple(range(101)), {"method": 6}),
    AVIF: _AVIF,
    # libaom's encoder minds other measures unless told; with that, full colour pays
    AVIF_PSNR: _AVIF._replace(settings={**_AVIF.settings, "advanced": {"tune": "psnr"}}, variants=_SUBSAMPLING),
}
CODECS[AVIF_FAST] = CODECS[AVIF_PSNR]._replace(settings={**CODECS[AVIF_PSNR].settings, "speed": 4})


class Coded(NamedTuple):
    """A file and how it was made."""

    data: bytes
    setting: str
    seconds: float  # of this one file, not of the search


def present() -> list[str]:
    """Name the codecs that this machine's Pillow has, of those that meet kcgs in most groups."""
    return [name for name, codec in CODECS.items() if name != AVIF_FAST and features.check(codec.feature)]


def versions() -> str:
    """Say what encodes."""
    names = {"JPEG": "libjpeg_turbo", "WebP": "webp", "AVIF": "avif"}
    return f"Pillow {__version__}; " + ", ".join(f"{shown} {features.version(name)}" for shown, name in names.items())


def open_file(data: bytes) -> Tensor:
    """Decode any of the files to (3, H, W) in [0, 1]."""
    with Image.open(BytesIO(data)) as file:
        pixels = np.asarray(file.convert("RGB"))
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255


def largest(codec: str, image: Tensor, most: int, *, quick: bool = False) -> Coded:
    """Make the largest file of at most `most` bytes, or the smallest; of the variants' the one with the higher PSNR."""
    pixels = (image * 255).round().byte().permute(1, 2, 0).contiguous().numpy().tobytes()
    size, qualities, found = (image.shape[2], image.shape[1]), CODECS[codec].qualities, []
    for variant in range(len(CODECS[codec].variants)):
        encode = partial(_encode, codec, variant, quick, pixels, size)
        # the last that fits, the first where none does
        place = bisect_right(range(1, len(qualities)), most, key=lambda place: len(encode(qualities[place]).data))
        found.append(encode(qualities[place]))
    small = [coded for coded in found if len(coded.data) <= most]
    if not small:
        return min(found, key=lambda coded: len(coded.data))
    return max(small, key=lambda coded: float(psnr(open_file(coded.data), image)))


def lossless_bytes(labels: Tensor) -> int:
    """Size of a label map (H, W) as lossless WebP, with quality 100 and method 6; the ids themselves cost nothing."""
    index = torch.unique(labels, return_inverse=True)[1].cpu().numpy().astype(np.int32)
    levels = np.stack([index >> 16, index >> 8, index], -1).astype(np.uint8)
    file = BytesIO()
    image = Image.fromarray(levels if index.max() > 255 else levels[..., 2].copy())
    image.save(file, "WEBP", lossless=True, quality=100, method=6)
    return file.getbuffer().nbytes


# a slow codec's files at several targets are often the same
@lru_cache(maxsize=256)
def _encode(codec: str, variant: int, quick: bool, pixels: bytes, size: tuple[int, int], quality: int) -> Coded:
    kind, chosen = CODECS[codec], CODECS[codec].variants[variant]
    settings = {**kind.settings, **chosen}
    if quick and "speed" in settings:
        settings["speed"] = 6
    image, file = Image.frombytes("RGB", size, pixels), BytesIO()
    start = time.perf_counter()
    image.save(file, kind.format, quality=quality, **settings)
    seconds = time.perf_counter() - start
    return Coded(file.getvalue(), " ".join([f"quality {quality}", *chosen.values()]), seconds)
