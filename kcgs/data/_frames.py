"""Frames of a video one at a time, from a file through PyAV or from a folder of images."""

import os
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcgs._repr import shorten
from kcgs.data._yuv import rgb_from_frame
from kcgs.data.images import load_image

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
_HDR = {16: "PQ", 18: "HLG"}


class FrameReader(ABC):
    """The frames of a video, read one at a time on each pass; `read_video` makes it.

    An iterable of :math:`(3, H, W)` float32 in [0, 1]; every ``for`` starts anew. ``len()`` raises TypeError where the
    number of frames is not known, ``num_frames`` is None there.

    Attributes:
        path: the file or folder.
        size: (height, width) of every frame, upright.
        frame_rate: frames per second.
        num_frames: how many, as the file says; None where it does not.
    """

    path: Path
    size: tuple[int, int]
    frame_rate: Fraction
    num_frames: int | None

    @abstractmethod
    def __iter__(self) -> Iterator[Tensor]: ...

    def __len__(self) -> int:
        if self.num_frames is None:
            raise TypeError(f"{self.path} does not say how many frames it has: count them in a pass")
        return self.num_frames

    def __repr__(self) -> str:
        count = "unknown number of" if self.num_frames is None else self.num_frames
        height, width = self.size
        name = shorten(repr(str(self.path)), 100)
        return f"FrameReader({name}, {count} frames, {width} x {height}, {self.frame_rate} per second)"


class ImageFolder(FrameReader):
    """The images of a folder, in the order of their names."""

    def __init__(self, path: Path, frame_rate: Fraction) -> None:
        self.path, self.frame_rate = path, frame_rate
        self._files = list_files(path, IMAGE_SUFFIXES, "images")
        self.num_frames = len(self._files)
        height, width = load_image(self._files[0]).shape[-2:]
        self.size = (height, width)

    def __iter__(self) -> Iterator[Tensor]:
        for file in self._files:
            image = load_image(file)
            check_same_size(file, image, self.size, self._files[0])
            yield image


class VideoFile(FrameReader):
    """The first video stream of a file."""

    def __init__(self, path: Path, frame_rate: Fraction | None) -> None:
        self.path = path
        with _open(path) as container:
            stream = container.streams.video[0]
            rate = frame_rate or stream.average_rate or stream.guessed_rate
            if not rate:
                raise ValueError(f"{path} names no frame rate: pass frame_rate")
            first = next(container.decode(stream), None)
            if first is None:
                raise ValueError(f"cannot read {path}: its video stream holds no frames")
            self.num_frames = stream.frames or None
        self.frame_rate = Fraction(rate)
        self.size = (first.height, first.width) if _quarter_turns(first) % 2 == 0 else (first.width, first.height)
        if int(first.color_trc) in _HDR:
            warnings.warn(
                f"{path} is HDR ({_HDR[int(first.color_trc)]}): frames hold its values as coded, not mapped to SDR",
                stacklevel=3,
            )

    def __iter__(self) -> Iterator[Tensor]:
        with _open(self.path) as container:
            stream = container.streams.video[0]
            times: list[Any] = []
            for count, frame in enumerate(container.decode(stream)):
                if frame.is_corrupt:
                    raise ValueError(f"cannot read {self.path}: frame {count} is damaged")
                image = _upright(frame)
                check_same_size(f"frame {count} of {self.path}", image, self.size, "the first frame")
                times.append(frame.time)
                yield image
            _check_spacing(self.path, times)
            _check_end(self.path, container, times)


def list_files(folder: Path, suffixes: tuple[str, ...], kind: str) -> list[Path]:
    """Return the files of a folder with one of the suffixes, by name, runs of digits as the numbers they are."""
    if not folder.exists():
        raise FileNotFoundError(f"no such folder: {folder}")
    if not folder.is_dir():
        raise NotADirectoryError(f"path must be a folder of {kind}; got the file {folder}")
    files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and f.is_file() and f.name[0] != "."]
    if not files:
        raise ValueError(f"path must be a folder of {kind} ({', '.join(suffixes)}); {folder} has none")
    parts = {f: [int(p) if p.isdigit() else p for p in re.split(r"([0-9]+)", f.name)] for f in files}
    return sorted(files, key=lambda f: (parts[f], f.name))


def check_same_size(
    name: str | os.PathLike[str], value: Tensor, size: tuple[int, int], first: str | os.PathLike[str]
) -> None:
    """Refuse an image or a label map that is not of the size of the first."""
    if tuple(value.shape[-2:]) != size:
        raise ValueError(f"{name} must have the size of {first}, {size}; got {tuple(value.shape[-2:])}")


def import_av() -> Any:
    """Return PyAV, or say how to install it."""
    try:
        import av
    except ImportError as error:
        raise ImportError("video files need the package av: pip install 'kcgs[video]'") from error
    return av


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """Open a file with at least one video stream; errors of the library become ValueErrors that name the file."""
    av = import_av()
    try:
        with av.open(os.fspath(path)) as container:
            if not container.streams.video:
                kinds = sorted({stream.type for stream in container.streams}) or ["no"]
                raise ValueError(f"path must have a video stream; {path} has {' and '.join(kinds)} streams only")
            yield container
    except av.error.FFmpegError as error:
        raise ValueError(f"cannot read {path}: no video that FFmpeg knows, or cut short ({error.strerror})") from error


def _quarter_turns(frame: Any) -> int:
    """Return how often to turn a frame by 90 degrees, counterclockwise; cameras store how they were held."""
    return round(float(frame.rotation) / 90) % 4


def _upright(frame: Any) -> Tensor:
    image = rgb_from_frame(frame)
    turns = _quarter_turns(frame)
    return torch.rot90(image, turns, (1, 2)).contiguous() if turns else image


def _check_spacing(path: Path, times: list[Any]) -> None:
    """Warn where frames are not evenly spaced; a tenth covers time stamps rounded to milliseconds."""
    if len(times) < 3 or None in times:
        return
    steps = np.diff(np.array(times, dtype=np.float64))
    if (abs(steps - np.median(steps)) > 0.1 * np.median(steps) + 1.5e-3).any():
        text = f"{path} has a variable frame rate: its frames are taken as evenly spaced, none repeated or left out"
        warnings.warn(text, stacklevel=3)


def _check_end(path: Path, container: Any, times: list[Any]) -> None:
    """Warn where frames end before the file says; sound may last longer than they do."""
    if container.duration is None or len(container.streams) > 1 or len(times) < 2 or None in times:
        return
    length = container.duration / 1e6  # FFmpeg counts microseconds
    spacing = (times[-1] - times[0]) / (len(times) - 1)
    if times[-1] - times[0] + 2.5 * spacing + 0.1 < length:
        text = f"{path} may be cut short: it says {length:.2f} s, its frames end after {times[-1] - times[0]:.2f} s"
        warnings.warn(text, stacklevel=3)
