"""``load_image`` and ``save_image``: every kind of file that is documented, and the errors."""

import struct
import zlib
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image, ImageFile, ImageOps
from torch import Tensor

from kcgs.data import load_image, save_image

HEIGHT, WIDTH = 6, 9
LUMA = [0.299, 0.587, 0.114]
COLOR_TYPES = {1: 0, 3: 2, 4: 6}  # of PNG, by channels
ORIENTATION = 274


def random_samples(channels: int, dtype: type = np.uint8) -> np.ndarray:
    top = np.iinfo(dtype).max
    samples = np.random.default_rng(0).integers(0, top, (HEIGHT, WIDTH, channels), endpoint=True)
    return samples.astype(dtype)


def png_bytes(samples: np.ndarray, extra: Sequence[tuple[bytes, bytes]] = ()) -> bytes:
    """Write a PNG by the book, so that tests of 16 bits depend on no library."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    height, width, channels = samples.shape
    rows = samples.astype(samples.dtype.newbyteorder(">")).reshape(height, -1)
    lines = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, samples.dtype.itemsize * 8, COLOR_TYPES[channels], 0, 0, 0)
    chunks = [(b"IHDR", header), *extra, (b"IDAT", zlib.compress(lines)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*item) for item in chunks)


def pillow_bytes(image: Any, kind: str = "PNG", **options: Any) -> bytes:
    if isinstance(image, np.ndarray):
        image = Image.fromarray(image[..., 0] if image.shape[-1] == 1 else image)
    image.save(buffer := BytesIO(), kind, **options)
    return buffer.getvalue()


def tiff_bytes(samples: np.ndarray, **options: Any) -> bytes:
    options = {"photometric": "rgb" if samples.ndim == 3 and samples.shape[-1] > 2 else "minisblack"} | options
    if samples.ndim == 3 and samples.shape[-1] == 4:
        options = {"extrasamples": ["unassalpha"]} | options
    stored = samples[..., 0] if samples.ndim == 3 and samples.shape[-1] == 1 else samples
    tifffile.imwrite(buffer := BytesIO(), stored, **options)
    return buffer.getvalue()


def on_white(samples: np.ndarray) -> np.ndarray:
    values = samples / np.iinfo(samples.dtype).max
    return values[..., :-1] * values[..., -1:] + (1 - values[..., -1:])


def pixels(image: Tensor) -> np.ndarray:
    """Return (C, H, W) as (H, W, C)."""
    return image.permute(1, 2, 0).numpy()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


GREY, GREY_ALPHA, RGB, RGBA = (random_samples(channels) for channels in (1, 2, 3, 4))
DEEP = {channels: random_samples(channels, np.uint16) for channels in (1, 3, 4)}
FLOATS = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32)
PALETTE = Image.fromarray(RGB).quantize(16)
CLEAR_PALETTE = Image.fromarray(np.array([[0, 1, 2]], np.uint8))
CLEAR_PALETTE.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
KEY = (b"tRNS", struct.pack(">HHH", *RGB[0, 0].tolist()))
KEY_ALPHA = (RGB != RGB[0, 0]).any(-1, keepdims=True)
GRAYMAP = f"P5 {WIDTH} {HEIGHT} 65535\n".encode() + DEEP[1].astype(">u2").tobytes()
CMYK_RED = np.broadcast_to(np.array([0, 255, 255, 0], np.uint8), (8, 8, 4)).copy()
RED = np.broadcast_to([1.0, 0.0, 0.0], (8, 8, 3))
RAMP = np.linspace(0, 255, 32 * 48 * 3).reshape(32, 48, 3).astype(np.uint8)
EXACT, EIGHT_BITS, JPEG = 1e-6, 0.02, 0.05
# what is in the file, the argument `channels`, the pixels, and the tolerance
FILES: dict[str, tuple[bytes, str, Any, float]] = {
    "RGB": (pillow_bytes(RGB), "RGB", RGB / 255, EXACT),
    "RGB as L": (pillow_bytes(RGB), "L", RGB / 255 @ LUMA, EXACT),
    "RGBA": (pillow_bytes(RGBA), "RGBA", RGBA / 255, EXACT),
    "RGBA as RGB": (pillow_bytes(RGBA), "RGB", on_white(RGBA), EXACT),
    "grey as RGB": (pillow_bytes(GREY), "RGB", GREY.repeat(3, -1) / 255, EXACT),
    "one bit": (pillow_bytes(GREY > 127), "L", GREY > 127, EXACT),
    "grey and alpha": (pillow_bytes(GREY_ALPHA), "RGBA", GREY_ALPHA[..., [0, 0, 0, 1]] / 255, EXACT),
    "palette": (pillow_bytes(PALETTE), "RGB", np.asarray(PALETTE.convert("RGB")) / 255, EXACT),
    "palette with transparency": (
        pillow_bytes(CLEAR_PALETTE, transparency=bytes([0, 51, 255])), "RGB", [[[1, 1, 1], [0.8, 1, 0.8], [0, 0, 1]]],
        EXACT,
    ),
    "colour key": (png_bytes(RGB, [KEY]), "RGBA", np.concatenate([RGB / 255, KEY_ALPHA], -1), EXACT),
    "portable graymap": (GRAYMAP, "L", DEEP[1] / 65535, EXACT),
    "CMYK JPEG": (pillow_bytes(Image.fromarray(CMYK_RED, mode="CMYK"), "JPEG", quality=100), "RGB", RED, EIGHT_BITS),
    "JPEG": (pillow_bytes(RAMP, "JPEG", quality=95), "RGB", RAMP / 255, JPEG),
    "WebP": (pillow_bytes(RAMP, "WEBP", quality=95), "RGB", RAMP / 255, JPEG),
    "TIFF with white as zero": (tiff_bytes(DEEP[1], photometric="miniswhite"), "L", 1 - DEEP[1] / 65535, EXACT),
    "float TIFF": (tiff_bytes(FLOATS), "RGB", FLOATS, 0),
}  # fmt: skip
for count, name in ((1, "L"), (3, "RGB"), (4, "RGBA")):  # 16 bits, to less than one of 65,535 levels
    FILES[f"16-bit PNG {name}"] = png_bytes(DEEP[count]), name, DEEP[count] / 65535, EXACT
    FILES[f"16-bit TIFF {name}"] = tiff_bytes(DEEP[count]), name, DEEP[count] / 65535, EXACT
FILES["16-bit TIFF, big-endian"] = tiff_bytes(DEEP[3], byteorder=">", compression="zlib"), "RGB", DEEP[3] / 65535, EXACT
WHOLE = {
    "png": pillow_bytes(np.tile(RGB, (4, 4, 1))),
    "jpg": pillow_bytes(np.tile(RGB, (4, 4, 1)), "JPEG"),
    "webp": pillow_bytes(np.tile(RGB, (4, 4, 1)), "WEBP"),
    "tif": pillow_bytes(np.tile(RGB, (4, 4, 1)), "TIFF"),
    "gif": pillow_bytes(np.tile(RGB, (4, 4, 1)), "GIF"),
    "16.png": png_bytes(DEEP[3]),
    "16.tif": tiff_bytes(DEEP[3]),
}


def bad_float(value: float) -> bytes:
    samples = np.full((4, 4), 0.5, np.float32)
    samples[1, 2] = value
    return tiff_bytes(samples)


class TestLoadImage:
    @pytest.mark.filterwarnings("ignore:.*transparent pixels")
    @pytest.mark.parametrize("kind", FILES)
    def test_every_kind(self, tmp_path: Path, kind: str) -> None:
        data, channels, expected, tolerance = FILES[kind]
        image = load_image(write(tmp_path / "image", data), channels=channels)  # type: ignore[arg-type]
        assert image.dtype == torch.float32 and image.is_contiguous() and 0 <= image.min() <= image.max() <= 1
        np.testing.assert_allclose(pixels(image), np.reshape(expected, pixels(image).shape), atol=tolerance, rtol=0)

    @pytest.mark.parametrize("kind", ["GIF", "TIFF"])
    def test_first_frame(self, tmp_path: Path, kind: str) -> None:
        frames = [Image.new("RGB", (4, 3), color) for color in ("red", "lime", "blue")]
        data = pillow_bytes(frames[0], kind, save_all=True, append_images=frames[1:])
        with pytest.warns(UserWarning, match="image holds 3 images: the first is read"):
            first = load_image(str(write(tmp_path / "image", data)))[:, 0, 0]
        torch.testing.assert_close(first, torch.tensor([1.0, 0.0, 0.0]), atol=EIGHT_BITS, rtol=0)

    def test_transparent_pixels_are_a_warning(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.png", pillow_bytes(Image.new("RGBA", (4, 3), (255, 0, 0, 0))))
        with pytest.warns(UserWarning, match="a.png has transparent pixels: they are composed on white"):
            assert (load_image(path) == 1).all()

    @pytest.mark.parametrize(
        ("kind", "orientation"),
        [
            *(("JPEG", k) for k in range(1, 9)),
            ("TIFF", 6),
            ("16-bit PNG", 8),
            ("16-bit TIFF", 8),
        ],
    )
    def test_orientation(self, tmp_path: Path, kind: str, orientation: int) -> None:
        corners = np.zeros((16, 24, 3), np.uint8)
        corners[:8, :8], corners[8:, 16:] = (255, 0, 0), (0, 0, 255)
        exif = Image.Exif()
        exif[ORIENTATION] = orientation
        if kind == "16-bit PNG":
            data = png_bytes(corners.astype(np.uint16) * 257, [(b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))])
        elif kind == "16-bit TIFF":
            data = tiff_bytes(corners.astype(np.uint16) * 257, extratags=[(ORIENTATION, "H", 1, orientation, True)])
        else:
            data = pillow_bytes(corners, kind, exif=exif, quality=100)
        stored = Image.fromarray(corners)
        stored.getexif()[ORIENTATION] = orientation
        image, expected = load_image(write(tmp_path / "image", data)), np.asarray(ImageOps.exif_transpose(stored)) / 255
        assert pixels(image).shape == expected.shape
        blocks = slice(4, None, 8), slice(4, None, 8)  # their centres, which lossy compression leaves alone
        np.testing.assert_allclose(pixels(image)[blocks], expected[blocks], atol=EIGHT_BITS)

    @pytest.mark.parametrize(
        ("data", "message"),
        [
            *((data, r"cannot read .*a\.png") for data in (b"this is text", b"II*\0")),
            (bad_float(1.5), r"must be in \[0, 1\]; got"),
            (bad_float(float("nan")), "must be finite; got"),
            (tiff_bytes(np.ones((4, 4), np.uint32)), "uint32 samples have no stated white"),
            (tiff_bytes(np.ones((16, 16, 16), np.uint16), photometric="minisblack", volumetric=True, tile=(16, 16, 16)),
             "expected one image"),
            (tiff_bytes(DEEP[4], extrasamples=["assocalpha"]), "alpha not multiplied in"),
        ],
    )  # fmt: skip
    def test_bad_files(self, tmp_path: Path, data: bytes, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            load_image(write(tmp_path / "a.png", data))

    @pytest.mark.parametrize(
        ("data", "message"),
        [
            (pillow_bytes(GREY), "Image size .* exceeds limit of 40 pixels"),
            (tiff_bytes(DEEP[1]), "its header claims 54 pixels, more than twice the limit of 20"),
            (tiff_bytes(np.zeros((1, 1, 200), np.uint16), planarconfig="contig"), "its header claims 50 pixels"),
        ],
    )
    def test_limit_of_pillow(self, tmp_path: Path, data: bytes, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """The header is checked, before pixels are decoded."""
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 20)
        monkeypatch.setattr(ImageFile.ImageFile, "load", None)
        monkeypatch.setattr(tifffile.TiffPage, "asarray", None)
        with pytest.raises(ValueError, match=message):
            load_image(write(tmp_path / "a", data))

    @pytest.mark.parametrize("kind", WHOLE)
    def test_truncated(self, tmp_path: Path, kind: str) -> None:
        path = write(tmp_path / f"a.{kind}", WHOLE[kind][: len(WHOLE[kind]) // 2])
        with pytest.raises(ValueError, match=r"cannot read .*a\."):
            load_image(path)

    def test_bad_arguments(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"nothing\.png"):
            load_image(tmp_path / "nothing.png")
        with pytest.raises(IsADirectoryError):
            load_image(tmp_path)
        with pytest.raises(ValueError, match="channels must be .* got 'LA'"):
            load_image(tmp_path / "a.png", channels="LA")  # type: ignore[arg-type]


class TestSaveImage:
    @pytest.mark.parametrize(
        ("suffix", "samples", "channels"),
        [
            *((suffix, RGBA, "RGBA") for suffix in (".png", ".webp", ".tif", ".PNG")),
            (".png", GREY, "L"),
            *((suffix, RGB, "RGB") for suffix in (".tiff", ".bmp")),
        ],
    )
    def test_round_trip(self, tmp_path: Path, suffix: str, samples: np.ndarray, channels: Any) -> None:
        levels = torch.from_numpy(samples).permute(2, 0, 1).float() / 255
        save_image(tmp_path / f"a{suffix}", levels)
        image = load_image(tmp_path / f"a{suffix}", channels=channels)
        torch.testing.assert_close(image, levels, atol=EXACT, rtol=0)
        assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]

    @pytest.mark.parametrize("suffix", [".jpg", ".jpeg"])
    def test_jpeg_keeps_a_border_of_two_colours(self, tmp_path: Path, suffix: str) -> None:
        """Chroma subsampling would blur it."""
        image = torch.zeros(3, 16, 16)
        image[0, :, :7], image[2, :, 7:] = 1.0, 1.0
        save_image(tmp_path / f"a{suffix}", image)
        torch.testing.assert_close(load_image(tmp_path / f"a{suffix}"), image, atol=0.06, rtol=0)

    @pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
    def test_clips_and_rounds_half_up(self, tmp_path: Path, dtype: torch.dtype) -> None:
        values = torch.tensor([[[-3.0, 0.0, 0.5, 1.0, 7.0]]], dtype=dtype, requires_grad=True)
        save_image(tmp_path / "a.png", values)
        assert (load_image(tmp_path / "a.png", channels="L") * 255).round().tolist() == [[[0, 0, 128, 255, 255]]]

    @pytest.mark.parametrize(
        ("name", "image", "error", "message"),
        [
            *(
                ("a.png", torch.zeros(shape), ValueError, "image must (have|be one image|not be empty)")
                for shape in ((2, 4, 4), (2, 3, 4, 4), (3, 0, 4))
            ),
            ("a.png", torch.full((3, 4, 4), float("nan")), ValueError, "image must be finite"),
            ("a.png", torch.zeros(3, 4, 4, dtype=torch.uint8), TypeError, "image must"),
            ("a.png", np.zeros((4, 4, 3), int), TypeError, "image must"),
            *((name, RGB, ValueError, r"path must end in \.png.*got") for name in ("a", "a.npy")),
            *((name, torch.zeros(4, 4, 4), ValueError, "to hold alpha") for name in ("a.jpg", "a.bmp")),
            ("nowhere/a.png", RGB, FileNotFoundError, r"folder .*nowhere does not exist"),
        ],
    )
    def test_bad_arguments(self, tmp_path: Path, name: str, image: Any, error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            save_image(tmp_path / name, image)
        assert list(tmp_path.iterdir()) == []
