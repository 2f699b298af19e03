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
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from kcgs.data import load_image, save_image

HEIGHT, WIDTH = 6, 9
GRAY, RGB, RGBA = 0, 2, 6


def random_samples(channels: int, dtype: type = np.uint8, seed: int = 0) -> np.ndarray:
    top = np.iinfo(dtype).max
    samples = np.random.default_rng(seed).integers(0, top, (HEIGHT, WIDTH, channels), endpoint=True)
    return samples.astype(dtype)


def encode_png(samples: np.ndarray, color_type: int, extra: Sequence[tuple[bytes, bytes]] = ()) -> bytes:
    """Write a PNG by the book, so that 16-bit tests depend on no library."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    height, width = samples.shape[:2]
    depth = samples.dtype.itemsize * 8
    rows = samples.astype(samples.dtype.newbyteorder(">")).reshape(height, -1)
    lines = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    chunks = [(b"IHDR", header), *extra, (b"IDAT", zlib.compress(lines)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*item) for item in chunks)


def pixels(image: torch.Tensor) -> np.ndarray:
    """(C, H, W) in [0, 1] as (H, W, C)."""
    return image.permute(1, 2, 0).numpy()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def composed(samples: np.ndarray) -> np.ndarray:
    values = samples / np.iinfo(samples.dtype).max
    alpha = values[..., -1:]
    return values[..., :-1] * alpha + (1 - alpha)


class TestChannels:
    def test_rgb(self, tmp_path: Path) -> None:
        samples = random_samples(3)
        Image.fromarray(samples).save(tmp_path / "a.png")
        image = load_image(tmp_path / "a.png")
        assert image.dtype == torch.float32
        assert image.shape == (3, HEIGHT, WIDTH)
        assert image.is_contiguous()
        np.testing.assert_allclose(pixels(image), samples / 255, atol=1e-7)

    def test_path_as_string(self, tmp_path: Path) -> None:
        Image.fromarray(random_samples(3)).save(tmp_path / "a.png")
        assert torch.equal(load_image(str(tmp_path / "a.png")), load_image(tmp_path / "a.png"))

    def test_luma_of_rgb(self, tmp_path: Path) -> None:
        samples = random_samples(3)
        Image.fromarray(samples).save(tmp_path / "a.png")
        image = load_image(tmp_path / "a.png", channels="L")
        assert image.shape == (1, HEIGHT, WIDTH)
        np.testing.assert_allclose(pixels(image)[..., 0], samples / 255 @ [0.299, 0.587, 0.114], atol=1e-6)

    def test_white_does_not_pass_one(self, tmp_path: Path) -> None:
        Image.new("RGB", (3, 3), "white").save(tmp_path / "a.png")
        assert load_image(tmp_path / "a.png", channels="L").max() == 1.0

    def test_rgba_of_opaque_image(self, tmp_path: Path) -> None:
        Image.fromarray(random_samples(3)).save(tmp_path / "a.png")
        image = load_image(tmp_path / "a.png", channels="RGBA")
        assert image.shape == (4, HEIGHT, WIDTH)
        assert (image[3] == 1).all()

    def test_rgba_keeps_color_and_alpha(self, tmp_path: Path) -> None:
        samples = random_samples(4)
        Image.fromarray(samples).save(tmp_path / "a.png")
        np.testing.assert_allclose(pixels(load_image(tmp_path / "a.png", channels="RGBA")), samples / 255, atol=1e-7)

    @pytest.mark.filterwarnings("ignore:.*transparent pixels")
    def test_transparency_lies_on_white(self, tmp_path: Path) -> None:
        samples = random_samples(4)
        Image.fromarray(samples).save(tmp_path / "a.png")
        expected = composed(samples)
        image = load_image(tmp_path / "a.png")
        np.testing.assert_allclose(pixels(image), expected, atol=1e-6)
        gray = load_image(tmp_path / "a.png", channels="L")
        np.testing.assert_allclose(pixels(gray)[..., 0], expected @ [0.299, 0.587, 0.114], atol=1e-6)

    @pytest.mark.parametrize("channels", ["LA", "rgb", "", None, 3])
    def test_unknown_channels(self, tmp_path: Path, channels: Any) -> None:
        with pytest.raises(ValueError, match="channels must be .* got"):
            load_image(tmp_path / "a.png", channels=channels)


class TestModes:
    def test_gray(self, tmp_path: Path) -> None:
        samples = random_samples(1)
        Image.fromarray(samples[..., 0]).save(tmp_path / "a.png")
        np.testing.assert_allclose(pixels(load_image(tmp_path / "a.png", channels="L")), samples / 255, atol=1e-7)
        image = load_image(tmp_path / "a.png")
        np.testing.assert_allclose(pixels(image), samples.repeat(3, axis=-1) / 255, atol=1e-7)

    def test_one_bit(self, tmp_path: Path) -> None:
        bits = random_samples(1)[..., 0] > 127
        Image.fromarray(bits).save(tmp_path / "a.png")
        np.testing.assert_array_equal(load_image(tmp_path / "a.png", channels="L")[0], bits)

    @pytest.mark.filterwarnings("ignore:.*transparent pixels")
    def test_gray_and_alpha(self, tmp_path: Path) -> None:
        samples = random_samples(2)
        Image.fromarray(samples).save(tmp_path / "a.png")
        image = load_image(tmp_path / "a.png")
        np.testing.assert_allclose(pixels(image), composed(samples).repeat(3, axis=-1), atol=1e-6)
        straight = load_image(tmp_path / "a.png", channels="RGBA")
        np.testing.assert_allclose(pixels(straight), samples[..., [0, 0, 0, 1]] / 255, atol=1e-7)

    def test_palette(self, tmp_path: Path) -> None:
        stored = Image.fromarray(random_samples(3)).quantize(16)
        stored.save(tmp_path / "a.png")
        expected = np.asarray(stored.convert("RGB")) / 255
        np.testing.assert_allclose(pixels(load_image(tmp_path / "a.png")), expected, atol=1e-7)

    @pytest.mark.filterwarnings("ignore:.*transparent pixels")
    def test_palette_with_transparency(self, tmp_path: Path) -> None:
        stored = Image.fromarray(np.array([[0, 1, 2]], np.uint8))
        stored.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
        stored.save(tmp_path / "a.png", transparency=bytes([0, 51, 255]))
        image = load_image(tmp_path / "a.png")
        expected = [[1.0, 0.8, 0.0], [1.0, 1.0, 0.0], [1.0, 0.8, 1.0]]
        np.testing.assert_allclose(image[:, 0], expected, atol=1e-6)

    def test_color_key_of_gray(self, tmp_path: Path) -> None:
        top = 255
        samples: np.ndarray = np.array([top, top - 1, 0]).astype(np.uint8).reshape(1, 3, 1)
        key = (b"tRNS", struct.pack(">H", top - 1))
        path = write(tmp_path / "a.png", encode_png(samples, GRAY, [key]))
        image = load_image(path, channels="RGBA")
        np.testing.assert_array_equal(image[3], [[1, 0, 1]])
        np.testing.assert_allclose(image[0], samples[..., 0] / top, atol=1e-7)

    def test_color_key_of_rgb(self, tmp_path: Path) -> None:
        samples = random_samples(3)
        samples[2, 3] = samples[0, 0]
        key = (b"tRNS", struct.pack(">HHH", *samples[0, 0].tolist()))
        path = write(tmp_path / "a.png", encode_png(samples, RGB, [key]))
        alpha = load_image(path, channels="RGBA")[3]
        assert (alpha == 0).nonzero().tolist() == [[0, 0], [2, 3]]

    def test_portable_graymap_of_sixteen_bits(self, tmp_path: Path) -> None:
        samples = random_samples(1, np.uint16)
        header = f"P5 {WIDTH} {HEIGHT} 65535\n".encode()
        image = load_image(write(tmp_path / "a.pgm", header + samples.astype(">u2").tobytes()), channels="L")
        np.testing.assert_array_equal(np.rint(pixels(image) * 65535), samples)

    def test_cmyk(self, tmp_path: Path) -> None:
        samples = np.broadcast_to(np.array([0, 255, 255, 0], np.uint8), (8, 8, 4)).copy()
        Image.fromarray(samples, mode="CMYK").save(tmp_path / "a.tif")
        Image.fromarray(samples, mode="CMYK").save(tmp_path / "a.jpg", quality=100)
        red = torch.tensor([1.0, 0.0, 0.0])[:, None, None].expand(3, 8, 8)
        torch.testing.assert_close(load_image(tmp_path / "a.tif"), red)
        torch.testing.assert_close(load_image(tmp_path / "a.jpg"), red, atol=0.02, rtol=0)

    @pytest.mark.parametrize("suffix", ["jpg", "webp"])
    def test_lossy_formats(self, tmp_path: Path, suffix: str) -> None:
        ramp = np.linspace(0, 255, 32 * 48 * 3).reshape(32, 48, 3).astype(np.uint8)
        Image.fromarray(ramp).save(tmp_path / f"a.{suffix}", quality=95)
        image = load_image(tmp_path / f"a.{suffix}")
        np.testing.assert_allclose(pixels(image), ramp / 255, atol=0.05)

    def test_first_frame(self, tmp_path: Path) -> None:
        frames = [Image.new("RGB", (4, 3), color) for color in ("red", "lime", "blue")]
        for suffix in ("gif", "tif", "webp", "png"):
            path = tmp_path / f"a.{suffix}"
            frames[0].save(path, save_all=True, append_images=frames[1:])
            with pytest.warns(UserWarning, match=f"a.{suffix} holds 3 images: the first is read"):
                first = load_image(path)[:, 0, 0]
            torch.testing.assert_close(first, torch.tensor([1.0, 0.0, 0.0]), atol=0.02, rtol=0)

    def test_transparent_pixels_are_told_of(self, tmp_path: Path) -> None:
        path = tmp_path / "a.png"
        Image.new("RGBA", (4, 3), (255, 0, 0, 0)).save(path)
        with pytest.warns(UserWarning, match="a.png has transparent pixels: they are composed on white"):
            assert (load_image(path) == 1).all()
        assert load_image(path, channels="RGBA")[3].max() == 0


class TestSixteenBits:
    @pytest.mark.parametrize(("channels", "color_type"), [(1, GRAY), (3, RGB), (4, RGBA)], ids=["L", "RGB", "RGBA"])
    def test_png_keeps_full_precision(self, tmp_path: Path, channels: int, color_type: int) -> None:
        samples = random_samples(channels, np.uint16)
        path = write(tmp_path / "a.png", encode_png(samples, color_type))
        expected = samples[..., {1: [0, 0, 0], 3: [0, 1, 2], 4: [0, 1, 2, 3]}[channels]]
        image = load_image(path, channels="RGBA")
        # Back to integers exactly: no precision was lost.
        np.testing.assert_array_equal(np.rint(pixels(image)[..., : expected.shape[-1]] * 65535), expected)

    @pytest.mark.parametrize("byteorder", ["<", ">"])
    @pytest.mark.parametrize("compression", [None, "zlib"])
    @pytest.mark.parametrize("channels", [1, 3, 4])
    def test_tiff_keeps_full_precision(
        self, tmp_path: Path, byteorder: Any, compression: str | None, channels: int
    ) -> None:
        samples = random_samples(channels, np.uint16)
        options: dict[str, Any] = {"photometric": "minisblack" if channels == 1 else "rgb"}
        if channels == 4:
            options["extrasamples"] = ["unassalpha"]
        stored = samples[..., 0] if channels == 1 else samples
        tifffile.imwrite(tmp_path / "a.tif", stored, byteorder=byteorder, compression=compression, **options)
        image = load_image(tmp_path / "a.tif", channels="L" if channels == 1 else "RGBA")
        np.testing.assert_array_equal(np.rint(pixels(image)[..., :channels] * 65535), samples)

    def test_tiff_with_white_as_zero(self, tmp_path: Path) -> None:
        samples = random_samples(1, np.uint16)[..., 0]
        tifffile.imwrite(tmp_path / "a.tif", samples, photometric="miniswhite")
        image = load_image(tmp_path / "a.tif", channels="L")
        np.testing.assert_array_equal(np.rint(image[0].numpy() * 65535), 65535 - samples.astype(int))


class TestFloatTiff:
    @pytest.mark.parametrize("channels", [1, 3])
    def test_in_range(self, tmp_path: Path, channels: int) -> None:
        samples = np.random.default_rng(0).random((HEIGHT, WIDTH, channels)).astype(np.float32)
        photometric: Any = "rgb" if channels == 3 else "minisblack"
        tifffile.imwrite(tmp_path / "a.tif", samples if channels == 3 else samples[..., 0], photometric=photometric)
        image = load_image(tmp_path / "a.tif", channels="RGB" if channels == 3 else "L")
        np.testing.assert_array_equal(pixels(image), samples)

    @pytest.mark.parametrize("bad", [-0.5, 1.5, float("nan"), float("inf")])
    def test_out_of_range(self, tmp_path: Path, bad: float) -> None:
        samples = np.full((4, 4), 0.5, np.float32)
        samples[1, 2] = bad
        tifffile.imwrite(tmp_path / "a.tif", samples)
        with pytest.raises(ValueError, match=r"a\.tif must be (in \[0, 1\]|finite); got"):
            load_image(tmp_path / "a.tif")

    def test_32_bit_integers_have_no_white(self, tmp_path: Path) -> None:
        tifffile.imwrite(tmp_path / "a.tif", np.ones((4, 4), np.uint32))
        with pytest.raises(ValueError, match="uint32 samples have no stated white"):
            load_image(tmp_path / "a.tif")

    def test_volume_is_refused(self, tmp_path: Path) -> None:
        tifffile.imwrite(tmp_path / "a.tif", np.ones((16, 16, 16), np.uint16), volumetric=True, tile=(16, 16, 16))
        with pytest.raises(ValueError, match="expected one image"):
            load_image(tmp_path / "a.tif")

    def test_multiplied_alpha_is_refused(self, tmp_path: Path) -> None:
        tifffile.imwrite(
            tmp_path / "a.tif", random_samples(4, np.uint16), photometric="rgb", extrasamples=["assocalpha"]
        )
        with pytest.raises(ValueError, match="alpha not multiplied in"):
            load_image(tmp_path / "a.tif")


class TestOrientation:
    @pytest.mark.parametrize("orientation", range(1, 9))
    @pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
    def test_eight_bits(self, tmp_path: Path, suffix: str, orientation: int) -> None:
        corner = np.zeros((16, 24, 3), np.uint8)
        corner[:8, :8] = (255, 0, 0)
        corner[8:, 16:] = (0, 0, 255)
        exif = Image.Exif()
        exif[274] = orientation
        stored = Image.fromarray(corner)
        stored.save(tmp_path / f"a.{suffix}", exif=exif, quality=100)
        with Image.open(tmp_path / f"a.{suffix}") as stored:
            expected = np.asarray(ImageOps.exif_transpose(stored).convert("RGB"))
        assert expected.shape[:2] == ((16, 24) if orientation < 5 else (24, 16))
        np.testing.assert_allclose(pixels(load_image(tmp_path / f"a.{suffix}")), expected / 255, atol=1e-6)

    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_sixteen_bits(self, tmp_path: Path, orientation: int) -> None:
        samples = random_samples(3, np.uint16)
        exif = Image.Exif()
        exif[274] = orientation
        block = (b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))
        png = write(tmp_path / "a.png", encode_png(samples, RGB, [block]))
        tags: Any = [(274, "H", 1, orientation, True)]
        tifffile.imwrite(tmp_path / "a.tif", samples, photometric="rgb", extratags=tags)
        high_bytes = Image.fromarray((samples >> 8).astype(np.uint8))
        high_bytes.getexif()[274] = orientation
        expected = np.asarray(ImageOps.exif_transpose(high_bytes))
        for path in (png, tmp_path / "a.tif"):
            values = np.rint(pixels(load_image(path)) * 65535).astype(np.uint16)
            np.testing.assert_array_equal(values >> 8, expected)


def encoded(suffix: str) -> bytes:
    if suffix == "16.png":
        return encode_png(random_samples(3, np.uint16), RGB)
    buffer = BytesIO()
    if suffix == "16.tif":
        tifffile.imwrite(buffer, random_samples(3, np.uint16), photometric="rgb")
        return buffer.getvalue()
    kind = {"png": "PNG", "jpg": "JPEG", "webp": "WEBP", "tif": "TIFF", "gif": "GIF"}[suffix]
    Image.fromarray(np.tile(random_samples(3), (4, 4, 1))).save(buffer, format=kind)
    return buffer.getvalue()


class TestBadFiles:
    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"nothing\.png"):
            load_image(tmp_path / "nothing.png")

    def test_folder(self, tmp_path: Path) -> None:
        with pytest.raises(IsADirectoryError):
            load_image(tmp_path)

    @pytest.mark.parametrize("content", [b"", b"hello, this is text", b"\x89PNG\r\n\x1a\n", b"II*\0"])
    def test_no_image(self, tmp_path: Path, content: bytes) -> None:
        with pytest.raises(ValueError, match=r"cannot read .*a\.png"):
            load_image(write(tmp_path / "a.png", content))

    @pytest.mark.parametrize("share", [0.3, 0.8])
    @pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif", "gif", "16.png", "16.tif"])
    def test_truncated(self, tmp_path: Path, suffix: str, share: float) -> None:
        data = encoded(suffix)
        path = write(tmp_path / f"a.{suffix}", data[: int(len(data) * share)])
        with pytest.raises(ValueError, match=r"cannot read .*a\."):
            load_image(path)

    @pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif", "gif", "16.png", "16.tif"])
    @settings(max_examples=30)
    @given(data=st.data())
    def test_damaged_bytes_give_an_image_or_value_error(self, tmp_path: Path, suffix: str, data: st.DataObject) -> None:
        damaged = bytearray(encoded(suffix))
        for _ in range(data.draw(st.integers(1, 4))):
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
        path = write(tmp_path / f"a.{suffix}", bytes(damaged))
        try:
            image = load_image(path)
        except ValueError as error:
            assert str(path) in str(error)
        else:
            assert image.shape[0] == 3
            assert 0 <= image.min() <= image.max() <= 1


class TestSave:
    @pytest.mark.parametrize("suffix", [".png", ".webp", ".tif", ".tiff", ".bmp", ".PNG"])
    @pytest.mark.parametrize("channels", [1, 3])
    def test_round_trip(self, tmp_path: Path, suffix: str, channels: int) -> None:
        levels = torch.from_numpy(random_samples(channels)).permute(2, 0, 1).float() / 255
        save_image(tmp_path / f"a{suffix}", levels)
        image = load_image(tmp_path / f"a{suffix}", channels="L" if channels == 1 else "RGB")
        torch.testing.assert_close(image, levels, atol=1e-6, rtol=0)
        assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]

    @pytest.mark.parametrize("suffix", [".png", ".webp", ".tif"])
    def test_round_trip_with_alpha(self, tmp_path: Path, suffix: str) -> None:
        levels = torch.from_numpy(random_samples(4)).permute(2, 0, 1).float() / 255
        save_image(tmp_path / f"a{suffix}", levels)
        torch.testing.assert_close(load_image(tmp_path / f"a{suffix}", channels="RGBA"), levels, atol=1e-6, rtol=0)

    @pytest.mark.parametrize("suffix", [".jpg", ".jpeg"])
    def test_jpeg(self, tmp_path: Path, suffix: str) -> None:
        # A sharp border of two colours: chroma subsampling would spread it.
        image = torch.zeros(3, 16, 16)
        image[0, :, :7], image[2, :, 7:] = 1.0, 1.0
        save_image(tmp_path / f"a{suffix}", image)
        torch.testing.assert_close(load_image(tmp_path / f"a{suffix}"), image, atol=0.06, rtol=0)

    def test_clips_and_rounds_half_up(self, tmp_path: Path) -> None:
        values = torch.tensor([[[-3.0, 0.0, 0.49 / 255, 0.5 / 255, 100.5 / 255, 254.6 / 255, 1.0, 7.0]]])
        save_image(tmp_path / "a.png", values.double())
        with Image.open(tmp_path / "a.png") as stored:
            assert np.asarray(stored).tolist() == [[0, 0, 0, 1, 101, 255, 255, 255]]

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
    def test_any_floating_type_with_gradient(self, tmp_path: Path, dtype: torch.dtype) -> None:
        save_image(tmp_path / "a.png", torch.full((3, 2, 2), 0.5, dtype=dtype, requires_grad=True))
        torch.testing.assert_close(load_image(tmp_path / "a.png"), torch.full((3, 2, 2), 128 / 255))

    @pytest.mark.parametrize("shape", [(2, 4, 4), (5, 4, 4), (4, 4), (2, 3, 4, 4), (3, 0, 4)])
    def test_shape(self, tmp_path: Path, shape: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match="image must (have|be one image|not be empty)"):
            save_image(tmp_path / "a.png", torch.zeros(shape))

    @pytest.mark.parametrize("image", [torch.zeros(3, 4, 4, dtype=torch.uint8), np.zeros((4, 4, 3), int), None])
    def test_type(self, tmp_path: Path, image: Any) -> None:
        with pytest.raises(TypeError, match="image must"):
            save_image(tmp_path / "a.png", image)

    def test_arrays_and_pil_images(self, tmp_path: Path) -> None:
        samples = random_samples(3)
        for image in (samples, Image.fromarray(samples), samples / 255):
            save_image(tmp_path / "a.png", image)
            np.testing.assert_allclose(pixels(load_image(tmp_path / "a.png")), samples / 255, atol=1e-7)

    def test_not_finite(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="image must be finite"):
            save_image(tmp_path / "a.png", torch.full((3, 4, 4), float("nan")))

    @pytest.mark.parametrize("name", ["a", "a.xyz", "a.npy"])
    def test_suffix(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(ValueError, match=r"path must end in \.png.*got"):
            save_image(tmp_path / name, torch.zeros(3, 4, 4))

    @pytest.mark.parametrize("name", ["a.jpg", "a.bmp"])
    def test_format_without_alpha(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(ValueError, match="to hold alpha"):
            save_image(tmp_path / name, torch.zeros(4, 4, 4))

    def test_missing_folder(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"folder .*nowhere does not exist"):
            save_image(tmp_path / "nowhere" / "a.png", torch.zeros(3, 4, 4))

    def test_failure_keeps_the_old_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        save_image(tmp_path / "a.png", torch.ones(3, 4, 4))

        def fail(self: Image.Image, target: Path, **options: Any) -> None:
            Path(target).write_bytes(b"half")
            raise OSError("disk full")

        monkeypatch.setattr(Image.Image, "save", fail)
        with pytest.raises(OSError, match="disk full"):
            save_image(tmp_path / "a.png", torch.zeros(3, 4, 4))
        assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
        assert (load_image(tmp_path / "a.png") == 1).all()
