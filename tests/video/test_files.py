"""Videos and folders of frames, written and read."""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs.data import save_image, save_labels
from kcgs.video import read_label_maps, read_video, write_video

COLORS = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, 0, 0], [0.5, 0.5, 0.5]])


def color_bars(count: int = 4, height: int = 32, width: int = 192) -> Tensor:
    """Return saturated colours side by side, shifted by one bar per frame; (T, 3, H, W)."""
    columns = torch.arange(width) * len(COLORS) // width
    frames = [COLORS[(columns + k) % len(COLORS)].T[:, None].expand(3, height, width) for k in range(count)]
    return torch.stack(frames)


class TestVideoFiles:
    @pytest.fixture(autouse=True)
    def av(self) -> Any:
        return pytest.importorskip("av", reason="video files need PyAV: pip install av")

    @pytest.mark.parametrize(("name", "height", "width"), [("a.mp4", 32, 192), ("a.mkv", 33, 191)])
    def test_round_trip(self, tmp_path: Path, name: str, height: int, width: int) -> None:
        frames = color_bars(height=height, width=width)
        write_video(tmp_path / name, iter(frames), 30000 / 1001)
        video = read_video(tmp_path / name)
        assert video.size == (height, width)
        assert video.frame_rate == pytest.approx(30000 / 1001, abs=0.01)
        assert read_video(tmp_path / name, frame_rate=12.5).frame_rate == 12.5
        middles = [(2 * k + 1) * width // 12 for k in range(6)]
        copies = torch.stack(list(video))
        assert torch.equal(torch.stack(list(video)), copies)
        assert copies.shape == frames.shape and copies.dtype == torch.float32
        assert (copies - frames).abs().mean() < 0.01
        assert (copies - frames)[:, :, ::8, middles].abs().max() < 2.5 / 255
        assert os.listdir(tmp_path) == [name]

    def test_stream(self, tmp_path: Path, av: Any) -> None:
        """The file has its colour space, plays while it loads, and has the same bytes each time."""
        for name in "ab":
            write_video(tmp_path / f"{name}.mp4", list(color_bars()), 24.0)
        with av.open(str(tmp_path / "a.mp4")) as container:
            context = container.streams.video[0].codec_context
            tags = (context.colorspace, context.color_primaries, context.color_trc, context.color_range)
            assert (context.name, context.pix_fmt, tags) == ("h264", "yuv420p", (1, 1, 1, 1))
        data = (tmp_path / "a.mp4").read_bytes()
        assert data.index(b"moov") < data.index(b"mdat") and data == (tmp_path / "b.mp4").read_bytes()

    def test_rotation(self, tmp_path: Path) -> None:
        """Frames come upright where the track header has a rotation, clockwise, as telephones write it."""
        frames = color_bars(2)
        write_video(tmp_path / "a.mp4", frames, 24)
        data = (tmp_path / "a.mp4").read_bytes()
        start = data.index(b"tkhd") + 44
        matrix = struct.pack(">9i", *(65536 * value for value in (0, 1, 0, -1, 0, 0, 0, 0, 16384)))
        (tmp_path / "a.mp4").write_bytes(data[:start] + matrix + data[start + 36 :])
        video = read_video(tmp_path / "a.mp4")
        upright = torch.rot90(frames, -1, (2, 3))
        assert video.size == tuple(upright.shape[2:])
        assert (torch.stack(list(video)) - upright).abs().mean() < 0.01

    @pytest.mark.parametrize("share", [0.0, 0.95])
    def test_damaged(self, tmp_path: Path, share: float) -> None:
        write_video(tmp_path / "a.mp4", torch.rand(30, 3, 32, 48), 24)
        data = (tmp_path / "a.mp4").read_bytes()
        (tmp_path / "a.mp4").write_bytes(data[: int(share * len(data))])
        with pytest.raises(ValueError, match=r"cannot read .*a\.mp4"):
            list(read_video(tmp_path / "a.mp4"))

    def test_sound_only(self, tmp_path: Path, av: Any) -> None:
        with av.open(str(tmp_path / "a.wav"), "w") as container:
            stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
            sound = av.AudioFrame(format="s16", layout="mono", samples=800)
            sound.sample_rate = 8000
            container.mux(stream.encode(sound))
        with pytest.raises(ValueError, match=r"a\.wav has no video stream"):
            read_video(tmp_path / "a.wav")

    def test_error_between_frames(self, tmp_path: Path) -> None:
        """No file is left."""

        def broken() -> Iterator[Tensor]:
            yield from color_bars(2)
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_video(tmp_path / "a.mp4", broken(), 24)
        assert not os.listdir(tmp_path)


class TestFolders:
    def test_round_trip(self, tmp_path: Path) -> None:
        frames = (color_bars() * 255).round() / 255
        (tmp_path / "clip").mkdir()  # an empty folder is filled
        write_video(tmp_path / "clip", 3 * frames - 1, 24)  # values are clipped
        (tmp_path / "clip" / "notes.txt").touch()
        video = read_video(tmp_path / "clip")
        assert (video.size, video.frame_rate) == ((32, 192), 24)
        assert torch.equal(torch.stack(list(video)), (3 * frames - 1).clamp(0, 1).mul(255).add(0.5).floor() / 255)

    def test_natural_order(self, tmp_path: Path) -> None:
        for number in (10, 9, 100):
            save_image(tmp_path / f"{number}.png", torch.full((3, 4, 4), number / 255))
        assert [round(float(frame.max()) * 255) for frame in read_video(tmp_path)] == [9, 10, 100]

    def test_label_maps(self, tmp_path: Path) -> None:
        """Ids are the same in every map, as colours and as values."""
        save_labels(tmp_path / "10.png", torch.tensor([[70000, 70000]]), rgb_ids=True)
        save_labels(tmp_path / "9.npy", torch.tensor([[0, 70000]]))
        maps = read_label_maps(tmp_path)
        assert [labels.tolist() for labels in maps] == [[[0, 70000]], [[70000, 70000]]]
        assert all(labels.dtype == torch.int64 for labels in maps)


class TestExceptions:
    @pytest.mark.parametrize("read", [read_video, read_label_maps])
    def test_missing_and_empty(self, tmp_path: Path, read: Any) -> None:
        with pytest.raises(FileNotFoundError, match="nothing"):
            read(tmp_path / "nothing")
        with pytest.raises(ValueError, match="has no"):
            read(tmp_path)

    @pytest.mark.parametrize(
        ("frames", "frame_rate", "match"),
        [
            ([], 24, "frames must hold at least one frame"),
            ([torch.zeros(1, 8, 8)], 24, r"frame 0 must have shape \(3, 8, 8\); got \(1, 8, 8\)"),
            ([torch.full((3, 8, 8), float("nan"))], 24, "frame 0 must be finite"),
            ([torch.zeros(3, 8, 8)], 0, "frame_rate must be finite and above 0"),
        ],
    )
    def test_arguments(self, tmp_path: Path, frames: list[Tensor], frame_rate: float, match: str) -> None:
        with pytest.raises(ValueError, match=match):
            write_video(tmp_path / "clip", frames, frame_rate)
        assert not os.listdir(tmp_path)

    def test_sizes_differ(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"frame 1 must have shape \(3, 8, 8\); got \(3, 8, 6\)"):
            write_video(tmp_path / "clip", [torch.zeros(3, 8, 8), torch.zeros(3, 8, 6)], 24)

    @pytest.mark.parametrize(
        ("name", "error", "match"),
        [
            (".", FileExistsError, "expected a new or an empty folder"),
            ("none/clip", FileNotFoundError, "none"),
            ("none/a.mp4", FileNotFoundError, "none"),
            ("a.avi", ValueError, r"path must end in .mp4, .mov, .mkv, or have no suffix; got '.*a.avi'"),
        ],
    )
    def test_output_folders(self, tmp_path: Path, name: str, error: type[Exception], match: str) -> None:
        (tmp_path / "notes.txt").touch()
        with pytest.raises(error, match=match):
            write_video(tmp_path / name, color_bars(), 24)

    def test_without_pyav(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "av", None)
        (tmp_path / "a.mp4").touch()
        with pytest.raises(ImportError, match=r"pip install av"):
            read_video(tmp_path / "a.mp4")
        with pytest.raises(ImportError, match=r"pip install av"):
            write_video(tmp_path / "b.mp4", color_bars(), 24)
        assert os.listdir(tmp_path) == ["a.mp4"]
