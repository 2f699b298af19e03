"""Videos and folders of frames, read and written; the files are made here."""

from __future__ import annotations

import builtins
import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from kcgs.data import read_label_maps, read_video, save_image, save_labels, write_video
from kcgs.functional import psnr

av = pytest.importorskip("av", reason="video files need PyAV: pip install 'kcgs[video]'")


def smooth_clip(count: int = 4, height: int = 32, width: int = 48) -> list[Tensor]:
    """A coloured gradient that moves."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    return [torch.stack([(x + k / 10) / 2, y, (x + y) / 2]).clamp(0, 1) for k in range(count)]


def needs_encoder(name: str) -> None:
    try:
        av.codec.Codec(name, "w")
    except ValueError:
        pytest.skip(f"the PyAV here has no encoder {name}")


def write_raw(path: Path, frames: list[Any], *, codec: str = "ffv1", rate: int = 25, **tags: int) -> None:
    """Store frames of PyAV as they are."""
    needs_encoder(codec)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = frames[0].width, frames[0].height, frames[0].format.name
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for frame in frames:
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def flat_frame(kind: str, levels: tuple[int, ...], **tags: int) -> Any:
    frame = av.VideoFrame(16, 8, kind)
    for plane, level in zip(frame.planes, levels, strict=True):
        samples = np.frombuffer(plane, np.uint16 if frame.format.components[0].bits > 8 else np.uint8)
        samples[:] = level
    for name, value in tags.items():
        setattr(frame, name, value)
    return frame


def rotate_mp4(path: Path, matrix: tuple[int, ...]) -> None:
    """Write a rotation into the track header, as telephones do."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    data[start : start + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in matrix)
    path.write_bytes(data)


class TestFiles:
    @pytest.mark.parametrize(("codec", "suffix"), [("libx264", ".mp4"), ("libx265", ".mp4"), ("libsvtav1", ".mkv")])
    def test_there_and_back(self, tmp_path: Path, codec: str, suffix: str) -> None:
        needs_encoder(codec)
        frames = smooth_clip(height=64, width=80)
        path = tmp_path / f"clip{suffix}"
        write_video(path, iter(frames), Fraction(30000, 1001), codec=codec)
        video = read_video(path)
        assert video.size == (64, 80)
        assert abs(video.frame_rate - Fraction(30000, 1001)) < 0.1
        for _ in range(2):
            back = list(video)
            assert len(back) == 4
            assert all(image.dtype == torch.float32 and image.shape == (3, 64, 80) for image in back)
            assert all(psnr(image, frame) > 38 for image, frame in zip(back, frames, strict=True))
        assert [entry.name for entry in tmp_path.iterdir()] == [path.name]

    def test_length_and_repr(self, tmp_path: Path) -> None:
        needs_encoder("libx264")
        write_video(tmp_path / "a.mp4", smooth_clip(), 24)
        video = read_video(tmp_path / "a.mp4")
        assert (len(video), video.num_frames, video.frame_rate) == (4, 4, 24)
        assert "4 frames, 48 x 32, 24 per second" in repr(video)
        write_video(tmp_path / "a.mkv", smooth_clip(), 24)
        video = read_video(tmp_path / "a.mkv", frame_rate=12.5)
        assert (video.num_frames, video.frame_rate) == (None, Fraction(25, 2))
        with pytest.raises(TypeError, match="does not say how many"):
            len(video)
        assert len(list(video)) == 4

    def test_same_frames_same_bytes(self, tmp_path: Path) -> None:
        needs_encoder("libx264")
        for name in ("a.mp4", "b.mp4"):
            write_video(tmp_path / name, torch.stack(smooth_clip()), 24)
        assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()

    def test_faststart(self, tmp_path: Path) -> None:
        needs_encoder("libx264")
        write_video(tmp_path / "a.mp4", smooth_clip(), 24)
        data = (tmp_path / "a.mp4").read_bytes()
        assert data.index(b"moov") < data.index(b"mdat")

    def test_odd_sizes(self, tmp_path: Path) -> None:
        needs_encoder("libx264")
        frames = smooth_clip(height=33, width=47)
        write_video(tmp_path / "a.mp4", frames, 24)
        video = read_video(tmp_path / "a.mp4")
        assert video.size == (33, 47)
        assert all(psnr(image, frame) > 38 for image, frame in zip(video, frames, strict=True))
        with pytest.raises(ValueError, match=r"cannot write .*a.mp4 \(47 x 33, yuv420p"):
            write_video(tmp_path / "a.mp4", frames, 24, pixel_format="yuv420p")
        assert read_video(tmp_path / "a.mp4").size == (33, 47)

    def test_one_frame_at_a_time(self, tmp_path: Path) -> None:
        """The writer asks for a frame when it needs it."""
        needs_encoder("ffv1")
        alive = []

        def frames() -> Iterator[Tensor]:
            for image in smooth_clip(3):
                alive.append(len(alive))
                yield image

        write_video(tmp_path / "a.mkv", frames(), 24, codec="ffv1", pixel_format="yuv444p")
        assert alive == [0, 1, 2]
        video = iter(read_video(tmp_path / "a.mkv"))
        assert psnr(next(video), smooth_clip(1)[0]) > 50

    @pytest.mark.parametrize("turns", [1, 2, 3])
    def test_rotation(self, tmp_path: Path, turns: int) -> None:
        """Matrices of the track header, a quarter turn clockwise each; the frames come upright."""
        needs_encoder("libx264")
        one = 1 << 16
        matrices = {
            1: (0, one, 0, -one, 0, 0, 0, 0, 1 << 30),
            2: (-one, 0, 0, 0, -one, 0, 0, 0, 1 << 30),
            3: (0, -one, 0, one, 0, 0, 0, 0, 1 << 30),
        }
        frames = smooth_clip(2)
        write_video(tmp_path / "a.mp4", frames, 24)
        rotate_mp4(tmp_path / "a.mp4", matrices[turns])
        video = read_video(tmp_path / "a.mp4")
        upright = [torch.rot90(frame, -turns, (1, 2)) for frame in frames]
        assert video.size == tuple(upright[0].shape[1:])
        assert all(psnr(image, frame) > 38 for image, frame in zip(video, upright, strict=True))

    def test_sound_is_ignored(self, tmp_path: Path) -> None:
        for name in ("libx264", "aac"):
            needs_encoder(name)
        for name, with_video in (("both.mp4", True), ("sound.mp4", False)):
            with av.open(str(tmp_path / name), "w") as container:
                audio = container.add_stream("aac", rate=8000, layout="mono")
                video = container.add_stream("libx264", rate=10) if with_video else None
                if video is not None:
                    video.width, video.height, video.pix_fmt = 16, 8, "yuv420p"
                    for number in range(3):
                        frame = flat_frame("yuv420p", (120, 128, 128))
                        frame.pts, frame.time_base = number, Fraction(1, 10)
                        container.mux(video.encode(frame))
                    container.mux(video.encode(None))
                sound = av.AudioFrame.from_ndarray(np.zeros((1, 2048), np.float32), "fltp", "mono")
                sound.sample_rate = 8000
                container.mux(audio.encode(sound))
                container.mux(audio.encode(None))
        assert len(list(read_video(tmp_path / "both.mp4"))) == 3
        with pytest.raises(ValueError, match="must have a video stream; .* has audio streams only"):
            read_video(tmp_path / "sound.mp4")

    def test_variable_frame_rate(self, tmp_path: Path) -> None:
        needs_encoder("ffv1")
        frames = [flat_frame("yuv420p", (100 + k, 128, 128)) for k in range(5)]
        for frame, pts in zip(frames, (0, 1, 2, 7, 8), strict=True):
            frame.pts, frame.time_base = pts, Fraction(1, 25)
        write_raw(tmp_path / "a.mkv", frames)
        video = read_video(tmp_path / "a.mkv")
        with pytest.warns(UserWarning, match="variable frame rate"):
            assert len(list(video)) == 5


class TestColors:
    """Values of flat frames, worked by hand from the matrices."""

    @pytest.mark.parametrize(
        ("tags", "expected"),
        [
            # 16 + 219 Y = 81, 128 + 224 Cb = 90, 128 + 224 Cr = 240: red in BT.601
            ({"colorspace": 6, "color_range": 1}, (0.9978, -0.0013, -0.0036)),
            ({}, (0.9978, -0.0013, -0.0036)),
            ({"colorspace": 1, "color_range": 1}, (1.0842, 0.0945, -0.0180)),
            ({"colorspace": 6, "color_range": 2}, (0.9334, 0.0553, 0.0536)),
        ],
    )
    def test_matrix_and_range(self, tmp_path: Path, tags: dict[str, int], expected: tuple[float, ...]) -> None:
        frames = [flat_frame("yuv420p", (81, 90, 240), **tags)]
        write_raw(tmp_path / "a.mkv", frames, **tags)
        (image,) = read_video(tmp_path / "a.mkv")
        wanted = torch.tensor(expected).clamp(0, 1)
        assert torch.allclose(image[:, 3, 5], wanted, atol=2e-3)
        assert torch.allclose(image, image[:, :1, :1].expand_as(image), atol=1e-6)

    def test_ten_bits_keep_their_precision(self, tmp_path: Path) -> None:
        frames = [flat_frame("yuv420p10le", (64 + level, 512, 512)) for level in (437, 438, 439)]
        write_raw(tmp_path / "a.mkv", frames, color_range=1)
        values = [float(image[1, 0, 0]) for image in read_video(tmp_path / "a.mkv")]
        assert values == pytest.approx([437 / 876, 438 / 876, 439 / 876], abs=1e-6)

    @pytest.mark.parametrize(("kind", "level"), [("gray", 51), ("gray10le", 204.6), ("gray16le", 13107)])
    def test_grey(self, tmp_path: Path, kind: str, level: float) -> None:
        write_raw(tmp_path / "a.mkv", [flat_frame(kind, (int(level),))])
        (image,) = read_video(tmp_path / "a.mkv")
        assert image.shape == (3, 8, 16)
        assert torch.allclose(image, torch.tensor(0.2), atol=1e-3)

    @pytest.mark.parametrize("kind", ["bgr0", "gbrp10le", "rgb48le"])
    def test_rgb(self, tmp_path: Path, kind: str) -> None:
        colors = torch.tensor([0.2, 0.4, 0.8])
        source = (colors.expand(8, 16, 3) * 65535).round().numpy().astype(np.uint16)
        frame = av.VideoFrame.from_ndarray(source, "rgb48le").reformat(format=kind)
        write_raw(tmp_path / "a.mkv", [frame])
        (image,) = read_video(tmp_path / "a.mkv")
        assert torch.allclose(image, colors[:, None, None].expand_as(image), atol=5e-3)

    def test_the_file_says_its_matrix(self, tmp_path: Path) -> None:
        needs_encoder("libx264")
        write_video(tmp_path / "a.mp4", smooth_clip(), 24)
        with av.open(str(tmp_path / "a.mp4")) as container:
            frame = next(container.decode(video=0))
        assert (int(frame.colorspace), int(frame.color_range)) == (1, 1)


class TestErrors:
    def test_no_such_file(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match="no such file or folder: .*none.mp4"):
            read_video(tmp_path / "none.mp4")

    def test_no_video(self, tmp_path: Path) -> None:
        (tmp_path / "a.mp4").write_bytes(b"hello" * 100)
        with pytest.raises(ValueError, match="cannot read .*a.mp4: no video that FFmpeg knows, or cut short"):
            read_video(tmp_path / "a.mp4")

    @pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
    def test_cut_short(self, tmp_path: Path, share: float) -> None:
        needs_encoder("libx264")
        noise = torch.rand(30, 3, 32, 48, generator=torch.Generator().manual_seed(0))
        write_video(tmp_path / "a.mp4", noise, 24)
        data = (tmp_path / "a.mp4").read_bytes()
        (tmp_path / "a.mp4").write_bytes(data[: int(share * len(data))])
        with pytest.raises(ValueError, match="cannot read .*a.mp4"):
            list(read_video(tmp_path / "a.mp4"))

    def test_matroska_cut_short(self, tmp_path: Path) -> None:
        """Such a file says how long it is, not how many frames it has."""
        frames = [flat_frame("yuv420p", (100 + k, 128, 128)) for k in range(40)]
        write_raw(tmp_path / "a.mkv", frames, rate=10)
        assert len(list(read_video(tmp_path / "a.mkv"))) == 40
        data = (tmp_path / "a.mkv").read_bytes()
        (tmp_path / "a.mkv").write_bytes(data[: len(data) // 2])
        with pytest.warns(UserWarning, match=r"may be cut short: it says 4.00 s, its frames end after"):
            assert len(list(read_video(tmp_path / "a.mkv"))) < 30

    def test_without_pyav(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        plain = builtins.__import__

        def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
            if name == "av":
                raise ImportError(name)
            return plain(name, *args, **kwargs)

        (tmp_path / "a.mp4").touch()
        monkeypatch.setattr(builtins, "__import__", refuse)
        with pytest.raises(ImportError, match=r"pip install 'kcgs\[video\]'"):
            read_video(tmp_path / "a.mp4")
        with pytest.raises(ImportError, match=r"pip install 'kcgs\[video\]'"):
            write_video(tmp_path / "b.mp4", smooth_clip(), 24)
        write_video(tmp_path / "folder", smooth_clip(), 24)  # images need no PyAV
        assert len(read_video(tmp_path / "folder")) == 4

    @pytest.mark.parametrize(
        ("arguments", "error", "words"),
        [
            ({"frames": []}, ValueError, "frames must hold at least one frame"),
            ({"frames": 3}, TypeError, "frames must be an iterable"),
            ({"frames": [torch.zeros(1, 8, 8)]}, ValueError, r"frame 0 must have shape \(3, H, W\); got \(1, 8, 8\)"),
            ({"frames": [torch.zeros(3, 8, 8), torch.zeros(3, 8, 6)]}, ValueError, "frame 1 must have shape"),
            ({"frames": [torch.full((3, 8, 8), float("nan"))]}, ValueError, "frame 0 must be finite"),
            ({"frame_rate": 0}, ValueError, "frame_rate must be in"),
            ({"frame_rate": "24"}, TypeError, "frame_rate must be a number"),
            ({"codec": "nothing"}, ValueError, "codec must be an encoder"),
            ({"crf": -1}, ValueError, "crf must be in"),
            ({"pixel_format": "rgb24"}, ValueError, "pixel_format must be one that libx264 takes"),
            ({"path": "a.nothing"}, ValueError, "path must end in a suffix of video"),
            ({"path": "none/a.mp4"}, FileNotFoundError, "folder .* does not exist"),
        ],
    )
    def test_write(self, tmp_path: Path, arguments: dict[str, Any], error: type[Exception], words: str) -> None:
        needs_encoder("libx264")
        given = {"path": "a.mp4", "frames": smooth_clip(2), "frame_rate": 24} | arguments
        path = tmp_path / given.pop("path")
        with pytest.raises(error, match=words):
            write_video(path, given.pop("frames"), given.pop("frame_rate"), **given)
        assert not list(tmp_path.iterdir())

    def test_what_fails_in_the_middle_leaves_the_old_file(self, tmp_path: Path) -> None:
        needs_encoder("libx264")

        def broken() -> Iterator[Tensor]:
            yield from smooth_clip(2)
            raise KeyboardInterrupt

        (tmp_path / "a.mp4").write_text("old")
        for path in (tmp_path / "a.mp4", tmp_path / "folder"):
            with pytest.raises(KeyboardInterrupt):
                write_video(path, broken(), 24)
        assert (tmp_path / "a.mp4").read_text() == "old"
        assert os.listdir(tmp_path) == ["a.mp4"]


class TestFolders:
    def test_there_and_back(self, tmp_path: Path) -> None:
        frames = [(frame * 255).round() / 255 for frame in smooth_clip()]
        (tmp_path / "clip").mkdir()  # empty: allowed
        write_video(tmp_path / "clip", frames, 24)
        (tmp_path / "clip" / "notes.txt").touch()
        video = read_video(tmp_path / "clip")
        assert (len(video), video.size, video.frame_rate) == (4, (32, 48), 24)
        assert read_video(tmp_path / "clip", frame_rate=30).frame_rate == 30
        for image, frame in zip(video, frames, strict=True):
            assert torch.allclose(image, frame, atol=1e-6)

    def test_a_full_folder_is_kept(self, tmp_path: Path) -> None:
        (tmp_path / "clip").mkdir()
        (tmp_path / "clip" / "notes.txt").touch()
        with pytest.raises(FileExistsError, match="it exists, expected a new or an empty folder"):
            write_video(tmp_path / "clip", smooth_clip(), 24)

    def test_numbers_in_names(self, tmp_path: Path) -> None:
        for number in (10, 9, 100):
            save_image(tmp_path / f"{number}.png", torch.full((3, 4, 4), number / 255))
            save_labels(tmp_path / f"{number}.npy", torch.full((4, 4), number))
        assert [round(float(image.max()) * 255) for image in read_video(tmp_path)] == [9, 10, 100]
        for image in tmp_path.glob("*.png"):
            image.unlink()
        assert [int(labels.max()) for labels in read_label_maps(tmp_path)] == [9, 10, 100]

    @pytest.mark.parametrize("read", [read_video, read_label_maps])
    def test_errors(self, tmp_path: Path, read: Any) -> None:
        with pytest.raises(ValueError, match="has none"):
            read(tmp_path)
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "none")
        for name, width in (("0.png", 4), ("1.png", 5)):
            save_labels(tmp_path / name, torch.zeros(3, width).long())
        with pytest.raises(ValueError, match=r"1.png must have the size of .*0.png, \(3, 4\); got \(3, 5\)"):
            list(read(tmp_path))


class TestLabelMaps:
    def test_maps(self, tmp_path: Path) -> None:
        maps = [torch.tensor([[0, k], [7, 300]]) for k in range(3)]
        for number, labels in enumerate(maps):
            save_labels(tmp_path / f"{number:05d}.png", labels)
        reader = read_label_maps(tmp_path)
        assert (len(reader), reader.size) == (3, (2, 2))
        for _ in range(2):
            assert all(labels.dtype == torch.int64 for labels in reader)
            assert [labels.tolist() for labels in reader] == [labels.tolist() for labels in maps]

    def test_a_color_has_one_id_in_all_frames(self, tmp_path: Path) -> None:
        save_labels(tmp_path / "0.png", torch.tensor([[0, 70000]]), rgb_ids=True)
        save_labels(tmp_path / "1.png", torch.tensor([[70000, 70000]]), rgb_ids=True)
        assert [labels.tolist() for labels in read_label_maps(tmp_path)] == [[[0, 70000]], [[70000, 70000]]]
