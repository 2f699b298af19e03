"""The other codecs, as Pillow has them, at the settings that make the most of their bytes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from io import BytesIO
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, features
from torch import Tensor

from kcgs.functional import psnr

JPEG, WEBP, AVIF, AVIF_PSNR = "JPEG", "WebP", "AVIF", "AVIF, tune=psnr"
# one quality for each of AVIF's 64 quantizers: the others give the same files
_AVIF_QUALITIES = tuple(sorted({((100 - q) * 63 + 50) // 100: q for q in range(101)}.values()))
# what twice the bytes are worth at low rates, where files of unequal sizes are compared
_DB_AN_OCTAVE = 3.0
_SUBSAMPLING = ("4:2:0", "4:4:4")


class Codec(NamedTuple):
    """A codec: its settings that do not change, and those of which the better is taken."""

    format: str  # of Pillow
    feature: str  # that Pillow must have
    qualities: tuple[int, ...]  # rising
    settings: dict[str, Any]
    variants: tuple[dict[str, Any], ...] = ({},)
    draft: Mapping[str, Any] = MappingProxyType(
        {}
    )  # settings that tell about which quality it will be, where the real ones are slow


_AVIF = Codec("AVIF", "avif", _AVIF_QUALITIES, {"speed": 0, "max_threads": 1}, draft={"speed": 6})
CODECS = {
    JPEG: Codec(
        "JPEG",
        "jpg",
        tuple(range(96)),
        {"optimize": True, "progressive": True},
        tuple({"subsampling": s} for s in _SUBSAMPLING),
    ),
    WEBP: Codec("WEBP", "webp", tuple(range(101)), {"method": 6}),
    AVIF: _AVIF,
    # libaom's encoder minds other measures unless told; with that, full colour pays
    AVIF_PSNR: _AVIF._replace(
        settings={**_AVIF.settings, "advanced": {"tune": "psnr"}},
        variants=tuple({"subsampling": s} for s in _SUBSAMPLING),
    ),
}


class Coded(NamedTuple):
    """A file and how it was made."""

    data: bytes
    setting: str
    seconds: float  # of this one file, not of the search


def present() -> list[str]:
    """Name the codecs that this machine's Pillow has."""
    return [name for name, codec in CODECS.items() if features.check(codec.feature)]


def versions() -> str:
    """Say what encodes."""
    from PIL import __version__

    names = {"JPEG": "libjpeg_turbo", "WebP": "webp", "AVIF": "avif"}
    found = {shown: features.version(name) for shown, name in names.items()}
    return f"Pillow {__version__}; " + ", ".join(f"{shown} {version}" for shown, version in found.items())


def open_file(data: bytes) -> Tensor:
    """Decode any of the files to (3, H, W) in [0, 1]."""
    with Image.open(BytesIO(data)) as file:
        pixels = np.asarray(file.convert("RGB"))
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255


def largest(codec: str, image: Tensor, most: int, *, exact: bool = True, quick: bool = False) -> Coded:
    """Make the largest file of at most `most` bytes, of the variants' the one with the higher PSNR.

    Args:
        codec: by name.
        image: (3, H, W) in [0, 1].
        most: bytes. Where the codec cannot go as low, the file is its smallest.
        exact: False: about `most` will do, for a curve.
        quick: AVIF at its draft's speed.
    """
    found = [_largest(codec, variant, image, most, exact, quick) for variant in CODECS[codec].variants]
    small = [one for one in found if len(one.data) <= most]
    if not small and exact:
        return min(found, key=lambda one: len(one.data))

    def merit(one: Coded) -> float:
        price = 0.0 if exact else _DB_AN_OCTAVE * math.log2(len(one.data))
        return float(psnr(open_file(one.data), image)) - price

    return max(small if exact else found, key=merit)


def _largest(codec: str, variant: dict[str, Any], image: Tensor, most: int, exact: bool, quick: bool) -> Coded:
    known = CODECS[codec]
    qualities, settings = known.qualities, {**known.settings, **variant}
    pixels = (image * 255).round().byte().permute(1, 2, 0).contiguous().numpy()

    def encode(place: int, options: dict[str, Any]) -> Coded:
        return _encode(known.format, pixels.tobytes(), pixels.shape[:2], qualities[place], _hashable(options))

    if quick:
        settings |= known.draft
    draft = {**settings, **known.draft}
    place = _last(len(qualities), lambda place: len(encode(place, draft).data) <= most)
    if draft == settings or not exact:
        return encode(place, settings)
    return encode(_walk(len(qualities), place, lambda place: len(encode(place, settings).data) <= most), settings)


def _last(count: int, fits: Callable[[int], bool]) -> int:
    """Return the last place that fits, if those that fit come first; 0 where none does."""
    low, high = 0, count - 1
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def _walk(count: int, place: int, fits: Callable[[int], bool]) -> int:
    """Return the same, from a place that must be near."""
    if fits(place):
        while place + 1 < count and fits(place + 1):
            place += 1
        return place
    while place > 0 and not fits(place):
        place -= 1
    return place


def _hashable(options: dict[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple((k, tuple(v.items()) if isinstance(v, dict) else v) for k, v in options.items())


# a slow codec's files at several targets are often the same
@lru_cache(maxsize=256)
def _encode(kind: str, pixels: bytes, size: Sequence[int], quality: int, options: tuple[tuple[str, Any], ...]) -> Coded:
    picture = Image.frombytes("RGB", (size[1], size[0]), pixels)
    named = {k: dict(v) if k == "advanced" else v for k, v in options}
    file = BytesIO()
    start = time.perf_counter()
    picture.save(file, kind, quality=quality, **named)
    seconds = time.perf_counter() - start
    setting = " ".join([f"quality {quality}", *(str(v) for k, v in options if k == "subsampling")])
    return Coded(file.getvalue(), setting, seconds)
