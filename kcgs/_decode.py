"""Image files as arrays of the samples that they store, at full precision.

Pillow reads all kinds but two, of which it would keep 8 bits: colour PNG of 16 bits per channel, which kornia_rs
reads, and TIFF of more than 8 bits or of floats, which tifffile reads.
"""

import logging
import os
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from kcgs._rows import row_slices

Array = NDArray[Any]

# tifffile also logs the defects of a file, which the error names already
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
# tag of the orientation in EXIF and TIFF
_ORIENTATION = 274
_CHANNELS = 4  # of an image at most; a TIFF may have more samples per pixel, which are decoded and left out
_LOSSLESS_FORMATS = ("PNG", "GIF", "BMP", "TIFF")


class Samples(NamedTuple):
    """The samples of one image."""

    values: Array  # (H, W, C): grey, grey and alpha, RGB or RGBA for C = 1 to 4, alpha not multiplied in
    white: float | None  # the sample value of full intensity; None where the file format does not say
    format: str  # as Pillow spells it
    lossless: bool  # whether the format gives back the very samples that were stored
    frames: int = 1  # number of images in the file: frames of an animation, or pages


def read_size(path: str | os.PathLike[str]) -> tuple[int, int] | None:
    """Read (height, width) of an upright image without its pixels; None where Pillow does not read the file."""
    try:
        with Image.open(path) as image:
            width, height = image.size
            return (width, height) if _orientation(image) >= 5 else (height, width)
    except Exception:  # reading the pixels raises the error with its cause
        return None


def _orientation(image: Image.Image) -> int:
    """Return the orientation in EXIF; 1 for a TIFF, which Pillow has turned already."""
    return 1 if image.format == "TIFF" else image.getexif().get(_ORIENTATION, 1)


def decode(path: str | os.PathLike[str], *, indices: bool = False) -> Samples:
    """Decode the first frame, upright by its EXIF orientation; `indices`: palette images as their indices."""
    data = Path(path).read_bytes()
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
    except Exception as error:  # decoders raise errors of many types for damaged files
        raise ValueError(f"cannot read {path} as an image: {error}") from error


def _pillow(data: bytes, image: Image.Image, indices: bool) -> Samples:
    # Pillow turns TIFF itself
    orientation = _orientation(image)
    # in a PNG, byte 24 is the number of bits, and byte 25 the kind of colours: 2 is RGB, 6 RGBA
    if data.startswith(_PNG) and data[24] == 16 and data[25] in (2, 6):
        from kornia_rs.io import decode_image_png_u16

        mode = "rgb" if data[25] == 2 else "rgba"
        image.close()  # frees its pixels of 8 bits
        values = np.asarray(decode_image_png_u16(data, (image.height, image.width), mode))
    else:
        values = pil_indices(image) if indices else pil_samples(image)
    values = _upright(values, orientation)
    white = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    # the second image in a photo of a telephone is no frame: it belongs to the first
    frames = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
    return Samples(values, white, image.format or "unknown", is_lossless(image), frames)


def is_lossless(image: Image.Image) -> bool:
    """Return whether the format of a file that Pillow opened gives back the very samples that were stored."""
    return image.format in _LOSSLESS_FORMATS and image.info.get("compression") != "jpeg"


def pil_samples(image: Any) -> NDArray[Any]:
    """Return the pixels of a PIL image, (H, W, C): grey, grey and alpha, RGB or RGBA, of uint8, uint16 or float32."""
    if image.mode == "F":
        return np.asarray(image)[..., None]
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow has in 32 bits for some formats
        return np.asarray(image).astype(np.uint16)[..., None]
    mode = "L" if image.mode in ("1", "L") else "RGB"
    if image.has_transparency_data:
        mode = "LA" if image.mode in ("LA", "La") else "RGBA"
    values = np.empty((image.height, image.width, len(mode)), np.uint8)
    for rows in row_slices(image.height, image.width):  # at once, Pillow would copy the pixels three times
        part = image.crop((0, rows.start, image.width, rows.stop)).convert(mode)
        values[rows] = np.asarray(part).reshape(values[rows].shape)
    return values


def pil_indices(image: Any) -> Array:
    """Return `pil_samples`, but a palette image as its indices, and grey of more than 8 bits as it is stored."""
    if image.mode in ("1", "P") or image.mode.startswith("I"):
        values = np.asarray(image)[..., None]
        return values.astype(np.uint8) if image.mode == "1" else values
    return pil_samples(image)


def _tiff(data: bytes) -> Samples | None:
    """Decode a grey or RGB TIFF of more than 8 bits or of floats; return None for others, which Pillow reads."""
    import tifffile
    from tifffile import EXTRASAMPLE, PHOTOMETRIC

    # closing the stream frees the data, which tifffile's reference cycle would keep
    with BytesIO(data) as stream, tifffile.TiffFile(stream) as file:
        page: Any = file.pages[0]
        is_grey = page.photometric in (PHOTOMETRIC.MINISBLACK, PHOTOMETRIC.MINISWHITE)
        is_unsigned = page.sampleformat == tifffile.SAMPLEFORMAT.UINT
        if not (is_grey or page.photometric == PHOTOMETRIC.RGB) or (is_unsigned and page.bitspersample in (1, 8)):
            return None
        alpha = page.extrasamples[0] if page.extrasamples else None
        if page.axes not in ("YX", "YXS") or alpha == EXTRASAMPLE.ASSOCALPHA:
            raise ValueError(f"its first page has axes {page.axes}; expected one image, alpha not multiplied in")
        # a damaged or hostile header can claim any size: the limit is that of Pillow for its own formats
        count, limit = max(page.imagewidth * page.imagelength, page.size // _CHANNELS), Image.MAX_IMAGE_PIXELS
        if limit is not None and count > 2 * limit:
            raise ValueError(f"its header claims {count} pixels, more than twice the limit of {limit}")
        values = page.asarray()
        orientation = page.tags[_ORIENTATION].value if _ORIENTATION in page.tags else 1
    channels = (1 if is_grey else 3) + (alpha == EXTRASAMPLE.UNASSALPHA)
    values = values[..., None] if page.axes == "YX" else values[..., :channels]
    white = None
    if values.dtype.kind == "f":
        white = 1.0
    elif is_unsigned and page.bitspersample <= 16:
        white = float(2**page.bitspersample - 1)
    if page.photometric == PHOTOMETRIC.MINISWHITE:
        values = ~values
    return Samples(_upright(values, orientation), white, "TIFF", True)


def _upright(values: Array, orientation: int) -> Array:
    """Apply an EXIF orientation to (H, W, C)."""
    if orientation >= 5:  # 5 to 8 are flips of the transposed image
        values = values.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        values = values[:, ::-1]
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    return values
