"""Video files (by PyAV), and folders of images or label maps; one frame is in memory at a time."""

import math
import os
import re
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs._check import check_number
from kcgs._image import as_image
from kcgs._suffixes import LABEL_MAPS, VIDEOS, WRITTEN_IMAGES
from kcgs.data import load_image, load_labels, save_image
from kcgs.errors import InvalidArgument

# frames per second if a file or an iterable has no rate
DEFAULT_FRAME_RATE = 24.0
# matrix, primaries and transfer in H.273
_BT709 = 1
# AVCOL_RANGE_MPEG
_LIMITED_RANGE = 1
# flags of swscale: bicubic, chroma of every pixel, accurate rounding; 2.8 dB better than the default
_SCALING = 0x4 | 0x2000 | 0x40000
# x264's constant rate factor: visually lossless
_RATE_FACTOR = 14
# largest denominator of a frame rate as a fraction
_MAX_DENOMINATOR = 65535


class Frames:
    """An iterable of frames :math:`(3, H, W)` in [0, 1] that reads the file again in every loop.

    It has the attributes ``size`` (H, W) and ``frame_rate``.
    """

    def __init__(self, path: Path, frame_rate: float | None) -> None:
        self._path = path
        first, stored_rate = next(self._read(), (None, 0.0))
        if first is None:
            raise ValueError(f"{path} has no frames")
        self.size: tuple[int, int] = (first.shape[1], first.shape[2])
        self.frame_rate = frame_rate or stored_rate

    def __iter__(self) -> Iterator[Tensor]:
        return (frame for frame, _ in self._read())

    def _read(self) -> Iterator[tuple[Tensor, float]]:
        if self._path.is_dir():
            return ((load_image(file), DEFAULT_FRAME_RATE) for file in _list_files(self._path, WRITTEN_IMAGES))
        return _decode(self._path)


def read_video(path: str | os.PathLike[str], *, frame_rate: float | None = None) -> Frames:
    """Open a video file or a folder of images as an iterable of frames.

    The first video stream of a file is read with 8 bits per channel and turned upright. Colours follow the matrix of
    the file, or BT.601 if it has none. HDR is not mapped, and a variable frame rate is not resampled. Images of a
    folder come in natural order, ``9.png`` before ``10.png``.

    Args:
        path: a video file (``pip install av``), or a folder of images that `load_image` reads.
        frame_rate: frames per second, above 0; None: the mean rate of the file, or 24 if it has none.

    Returns:
        The frames, :math:`(3, H, W)` float32 in [0, 1], with ``size`` (H, W) and ``frame_rate``.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        ImportError: ``path`` is a file and PyAV is not installed.
        ValueError: there is no frame or no video stream. In a loop: the file is damaged (a truncated Matroska file
            just ends early).

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(f"{folder}/clip", torch.rand(2, 3, 8, 10), 24)
        ...     video = read_video(f"{folder}/clip")
        ...     video.size, video.frame_rate, [tuple(frame.shape) for frame in video]
        ((8, 10), 24.0, [(3, 8, 10), (3, 8, 10)])
    """
    rate = None if frame_rate is None else check_number("frame_rate", frame_rate, 0, above=True)
    if not Path(path).exists():
        raise FileNotFoundError(f"no such file or folder: {path}")
    return Frames(Path(path), rate)


def read_label_maps(folder: str | os.PathLike[str]) -> list[Tensor]:
    """Read a folder of label maps, one per frame in natural order.

    Args:
        folder: files as `load_labels` reads them; a colour has the same id, R + 256 G + 65536 B, in every frame.

    Returns:
        The maps, :math:`(H, W)` int64, non-negative.

    Raises:
        FileNotFoundError: ``folder`` does not exist.
        ValueError: it has no label maps, or a file is damaged.

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(f"{folder}/maps", torch.zeros(2, 3, 4, 6), 24)
        ...     [(tuple(labels.shape), int(labels.max())) for labels in read_label_maps(f"{folder}/maps")]
        [((4, 6), 0), ((4, 6), 0)]
    """
    files = _list_files(Path(folder), LABEL_MAPS)
    if not files:
        raise ValueError(f"{folder} has no label maps ({', '.join(LABEL_MAPS)})")
    return [load_labels(file, rgb_ids=True) for file in files]


def write_video(path: str | os.PathLike[str], frames: Iterable[Any], frame_rate: float) -> None:
    """Write frames as a video file, atomically, or as a folder of PNG images.

    A file is visually lossless H.264 in BT.709; the same frames give the same bytes. Even sizes are yuv420p, which all
    players can play; odd sizes are yuv444p, which many browsers and phones cannot play.

    Args:
        path: .mp4, .mov or .mkv (``pip install av``); without a suffix, a new or empty folder, which gets
            ``00000.png``, ``00001.png`` and so on.
        frames: images :math:`(3, H, W)` of one size, or a tensor :math:`(T, 3, H, W)`; values are clipped to [0, 1].
        frame_rate: frames per second, above 0; a folder does not store it.

    Raises:
        FileExistsError: the folder ``path`` is not empty.
        FileNotFoundError: the folder above ``path`` does not exist.
        ImportError: PyAV is not installed.
        ValueError: there are no frames, a frame is no RGB image of the first frame's size, or the suffix is unknown.

    Example:
        >>> import os, tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(f"{folder}/clip", [torch.zeros(3, 8, 10)] * 2, 24)
        ...     sorted(os.listdir(f"{folder}/clip"))
        ['00000.png', '00001.png']
    """
    rate = check_number("frame_rate", frame_rate, 0, above=True)
    if Path(path).suffix.lower() not in ("", *VIDEOS):
        raise ValueError(f"path must end in {', '.join(VIDEOS)}, or have no suffix; got {str(path)!r}")
    images = _check_frames(frames)
    first = next(images)  # checked before anything is written
    images = chain([first], images)
    if not Path(path).suffix:
        return _write_folder(Path(path), images)
    with atomic_path(path) as temporary:
        _encode(temporary, images, (first.shape[1], first.shape[2]), Fraction(rate).limit_denominator(_MAX_DENOMINATOR))


def _list_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder in natural order: numbers are padded with zeros before names are compared."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes and not file.name.startswith(".")]
    return sorted(files, key=lambda file: (re.sub("[0-9]+", lambda digits: digits[0].zfill(20), file.name), file.name))


def _import_av() -> Any:
    try:
        import av
    except ImportError as error:
        raise ImportError("video files need PyAV: pip install av") from error
    return av


def _decode(path: Path) -> Iterator[tuple[Tensor, float]]:
    """Yield each frame with the frame rate of the file."""
    av = _import_av()
    try:
        with av.open(os.fspath(path)) as container:
            if not container.streams.video:
                raise ValueError(f"{path} has no video stream")
            rate = float(container.streams.video[0].average_rate or DEFAULT_FRAME_RATE)
            for number, frame in enumerate(container.decode(video=0)):
                if frame.is_corrupt:
                    raise ValueError(f"frame {number} of {path} is damaged")
                levels = np.rot90(frame.to_ndarray(format="rgb24", interpolation=_SCALING), round(frame.rotation / 90))
                yield torch.from_numpy(levels.transpose(2, 0, 1).astype(np.float32, order="C") / 255), rate
    except av.error.FFmpegError as error:
        raise ValueError(f"cannot read {path} as a video: {error.strerror}") from error


def _check_frames(frames: Iterable[Any]) -> Iterator[Tensor]:
    shape: tuple[int, ...] = ()
    for number, frame in enumerate(frames):
        image = as_image(f"frame {number}", frame, tolerance=math.inf)
        shape = shape or (3, *image.shape[1:])
        if image.shape != shape:
            raise ValueError(f"frame {number} must have shape {shape}; got {tuple(image.shape)}")
        yield image
    if not shape:
        raise InvalidArgument("frames", "at least one frame", "none", verb="hold")


def _encode(path: Path, images: Iterator[Tensor], size: tuple[int, int], rate: Fraction) -> None:
    av = _import_av()
    with av.open(os.fspath(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": str(_RATE_FACTOR)})
        stream.height, stream.width = size
        stream.pix_fmt = "yuv444p" if stream.height % 2 or stream.width % 2 else "yuv420p"
        context = stream.codec_context
        context.thread_count = 1  # the same bytes for any number of processors
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = _LIMITED_RANGE
        for number, image in enumerate(images):
            levels = (image.detach().float().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous()
            frame = av.VideoFrame.from_ndarray(levels.cpu().numpy(), "rgb24").reformat(
                format=stream.pix_fmt, dst_colorspace=_BT709, dst_color_range=_LIMITED_RANGE, interpolation=_SCALING
            )
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def _write_folder(folder: Path, images: Iterator[Tensor]) -> None:
    folder.mkdir(exist_ok=True)
    if any(folder.iterdir()):
        raise FileExistsError(f"cannot write {folder}: it exists, expected a new or an empty folder")
    for number, image in enumerate(images):
        save_image(folder / f"{number:05d}.png", image)
