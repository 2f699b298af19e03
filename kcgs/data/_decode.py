"""Image files as arrays of the samples they store, at full precision; the readers give them a meaning."""

import logging
import os
import re
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

Array = NDArray[Any]

# tifffile logs what ails a file besides raising; the error says it once.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_ORIENTATION = 274
# Compression tags of TIFF that keep samples exactly: none, CCITT, LZW, deflate, PackBits, LZMA, Zstandard.
_LOSSLESS_TIFF = (1, 2, 3, 4, 5, 8, 32773, 32946, 34925, 50000)
_LOSSLESS_FORMATS = ("PNG", "GIF", "BMP")


class Samples(NamedTuple):
    """The samples of one image."""

    values: Array  # (H, W, C): grey, grey and alpha, RGB or RGBA for C = 1 to 4, alpha not multiplied in
    white: float | None  # the sample value of full intensity; None where the file format does not say
    format: str  # as Pillow spells it
    lossless: bool  # whether the format is known to give back the very samples that were stored
    frames: int = 1  # of an animation, or pages


def read_file(path: str | os.PathLike[str]) -> bytes:
    """Return the bytes of `path`, or raise an error that names it."""
    file = Path(path)
    if file.is_dir():
        raise ValueError(f"path must be a file; got the folder {file}")
    try:
        return file.read_bytes()
    except FileNotFoundError:
        raise FileNotFoundError(f"no such file: {file}") from None


def decode(data: bytes, path: str | os.PathLike[str], *, indices: bool = False) -> Samples:
    """Decode the first frame, turned upright as its EXIF orientation says; errors name the path.

    With `indices`, return what label maps are stored as: palette indices instead of their colours, 1-, 2- and 4-bit
    grey unscaled, colour keys ignored.
    """
    try:
        samples = _tiff(data) if data.startswith(_TIFF) else None
        if samples is None:
            with Image.open(BytesIO(data)) as image:
                image.load()
                samples = _pillow(data, image, indices)
        if samples.values.ndim != 3 or samples.values.size == 0:
            raise ValueError(f"it holds samples of shape {samples.values.shape}, expected an image")
        return samples
    except MemoryError:
        raise
    except UnidentifiedImageError:
        raise ValueError(f"cannot read {path}: not an image in a known format") from None
    except Exception as error:  # Decoders raise whatever their corner of the format makes them stumble on.
        raise ValueError(f"cannot read {path} as an image: {error}") from error


def _pillow(data: bytes, image: Image.Image, indices: bool) -> Samples:
    if data.startswith(_PNG) and data[24] == 16 and data[25] in (2, 4, 6):  # 16 bits of colour or of grey and alpha
        values, white = _deep_png(data, image), 65535.0
    else:
        values, white = _stored(data, image) if indices else _shown(image)
    values = values[..., None] if values.ndim == 2 else values
    key = image.info.get("transparency")
    if key is not None and values.dtype == np.uint16 and values.shape[-1] in (1, 3) and not indices:
        # Pillow applies colour keys to 8-bit images only.
        opaque = (values != np.asarray(key)).any(axis=-1, keepdims=True)
        values = np.concatenate([values, np.where(opaque, 65535, 0).astype(np.uint16)], axis=-1)
    if image.format != "TIFF":  # Pillow turns those on loading.
        values = _upright(values, image.getexif().get(_ORIENTATION, 1))
    # photos of telephones hold a second image that is part of the first
    frames = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
    return Samples(values, white, image.format or "unknown", _is_lossless(data, image), frames)


def _shown(image: Image.Image) -> tuple[Array, float]:
    """Return the colours that a viewer would show and their white."""
    if image.mode == "I" and image.format not in ("PNG", "PPM"):  # These two put 16-bit grey into 32-bit integers.
        raise ValueError("32-bit integer samples have no stated white, expected 8 or 16 bits")
    if image.mode == "I" or image.mode.startswith("I;16"):
        return np.asarray(image).astype(np.uint16), 65535.0
    if image.mode == "F":
        _check_range(np.asarray(image))
        return np.asarray(image), 1.0
    if image.has_transparency_data:
        image = image.convert("LA" if image.mode in ("LA", "La") else "RGBA")
    elif image.mode not in ("L", "RGB"):
        image = image.convert("L" if image.mode == "1" else "RGB")
    return np.asarray(image), 255.0


def _stored(data: bytes, image: Image.Image) -> tuple[Array, float]:
    """Return the numbers in the file: palette indices, unscaled grey, or colours."""
    if image.mode == "PA":
        return np.asarray(image)[..., 0], 255.0
    if image.mode == "1":
        return np.asarray(image).astype(np.uint8), 1.0
    if image.mode == "L" and data.startswith(_PNG) and data[24] in (2, 4):
        white = 2 ** data[24] - 1
        return np.asarray(image) // (255 // white), float(white)
    if image.mode in ("P", "L", "LA", "RGB", "RGBA", "I", "F") or image.mode.startswith("I;16"):
        values = np.asarray(image)
        return (values.astype(np.uint16) if image.mode.startswith("I;16") else values), 255.0
    raise ValueError(f"label maps are grey, palette or RGB images; got mode {image.mode}")


def _deep_png(data: bytes, image: Image.Image) -> Array:
    """Return 16-bit colour, which Pillow would reduce to 8 bits."""
    if data[25] == 4:
        # A pixel of 16-bit grey and alpha has the four bytes of 8-bit RGBA, and PNG filters bytes: relabelled
        # as that, the file decodes to the high and low bytes of both samples.
        header = data[12:24] + bytes([8, 6]) + data[26:29]
        relabelled = data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
        with Image.open(BytesIO(relabelled)) as bytewise:
            halves = np.asarray(bytewise).astype(np.uint16)
        return halves[..., 0::2] * np.uint16(256) + halves[..., 1::2]
    from kornia_rs.io import decode_image_png_u16

    size = (image.height, image.width)
    return np.asarray(decode_image_png_u16(data, size, "rgb" if data[25] == 2 else "rgba"))


def _tiff(data: bytes) -> Samples | None:
    """Return a TIFF image that Pillow would reduce or refuse; None for the others."""
    import tifffile

    with tifffile.TiffFile(BytesIO(data)) as file:
        page: Any = file.pages[0]
        gray, rgb = int(page.photometric) in (0, 1), int(page.photometric) == 2
        unsigned = page.sampleformat == 1
        if not (gray or rgb) or (unsigned and page.bitspersample in (1, 8)):
            return None
        # Refuse what a damaged or hostile header claims, by the limit that Pillow has for its own formats.
        count, limit = page.imagewidth * page.imagelength * max(1, page.samplesperpixel // 4), Image.MAX_IMAGE_PIXELS
        if limit is not None and count > 2 * limit:
            raise ValueError(f"its header claims {count} pixels, more than twice the limit of {limit}")
        values = page.asarray()
        lossless = int(page.compression) in _LOSSLESS_TIFF
        orientation = page.tags[_ORIENTATION].value if _ORIENTATION in page.tags else 1
    if page.axes not in ("YX", "YXS", "SYX"):
        raise ValueError(f"the first page has axes {page.axes}, expected one image")
    values = values[..., None] if page.axes == "YX" else values
    values = np.moveaxis(values, 0, -1) if page.axes == "SYX" else values
    extra = int(page.extrasamples[0]) if page.extrasamples else 0
    values = values[..., : (3 if rgb else 1) + (extra in (1, 2))]
    white = None
    if values.dtype.kind == "f":
        white = 1.0
        _check_range(values)
    elif values.dtype.kind == "u" and page.bitspersample <= 16:
        white = float(2**page.bitspersample - 1)
    if int(page.photometric) == 0:
        values = values.copy()
        values[..., 0] = (white or np.iinfo(values.dtype).max) - values[..., 0]
    if extra == 1:
        values = _straight(values)
    return Samples(_upright(values, orientation), white, "TIFF", lossless)


def _straight(values: Array) -> Array:
    """Undo the multiplication of colour by alpha; what is fully transparent stays as it is."""
    alpha = values[..., -1:].astype(np.float64)
    top = 1.0 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
    color = values[..., :-1] * (top / np.where(alpha > 0, alpha, top))
    color = np.clip(color if values.dtype.kind == "f" else np.rint(color), 0, top)
    return np.concatenate([color.astype(values.dtype), values[..., -1:]], axis=-1)


def _check_range(values: Array) -> None:
    low, high = float(values.min()), float(values.max())
    if not (low >= 0.0 and high <= 1.0):  # Also true of NaN.
        raise ValueError(f"float samples must lie in [0, 1]; got [{low:g}, {high:g}]")


def _upright(values: Array, orientation: int) -> Array:
    """Apply an EXIF orientation to (H, W, C)."""
    if orientation >= 5:  # 5 to 8 are 1, 6: 3 flips of the transposed image.
        values = values.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        values = values[:, ::-1]
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    return values


def _is_lossless(data: bytes, image: Image.Image) -> bool:
    if image.format == "WEBP":
        first = re.search(rb"VP8[ L]", data)  # The chunk names of lossy and lossless pixels.
        return first is not None and first.group() == b"VP8L"
    if image.format == "TIFF":
        return int(getattr(image, "tag_v2", {}).get(259, 1)) in _LOSSLESS_TIFF
    return image.format in _LOSSLESS_FORMATS
