"""Videos: files and folders of images in, one frame at a time; files and folders of PNGs out."""

import os
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs._check import as_image, check_number
from kcgs._repr import shorten
from kcgs.data._frames import FrameReader, ImageFolder, VideoFile, check_same_size, import_av, list_files
from kcgs.data._yuv import frame_from_rgb, tag_bt709
from kcgs.data.images import save_image
from kcgs.data.labels import load_labels

__all__ = ["FrameReader", "LabelMapReader", "read_label_maps", "read_video", "write_video"]

_LABEL_SUFFIXES = (".png", ".npy", ".tif", ".tiff", ".bmp", ".gif", ".webp")
# Encoders that give other bytes with another number of threads are held to one.
_ONE_THREAD = {
    "libx264": {"x264-params": "threads=1"},
    "libx265": {"x265-params": "pools=none:frame-threads=1:log-level=none"},
    "libsvtav1": {"svtav1-params": "lp=1"},
}


def read_video(path: str | os.PathLike[str], *, frame_rate: float | Fraction | None = None) -> FrameReader:
    """Open a video: an iterable of its frames, which reads one at a time and starts anew on every pass.

    A file is read through PyAV (``pip install 'kcgs[video]'``): the first video stream, audio ignored, turned upright
    as its rotation says. Colours follow the matrix and range that it names; BT.709 from 720 rows on and BT.601 below,
    limited range, where it names none. More than 8 bits keep their precision, grey is repeated three times, alpha is
    ignored. Frames are taken as they are stored: interlaced ones are not separated, pixels that are not square not
    scaled, HDR not mapped, with a UserWarning; of a variable frame rate none is repeated or left out, and the rate is
    the mean, with a UserWarning at the end of a pass. A folder is read in the order of the names, ``9.png`` before
    ``10.png``; what is no image is skipped.

    Args:
        path: a video file, or a folder of images as `load_image` reads them.
        frame_rate: frames per second, above 0; None: what the file says, 24 for a folder.

    Returns:
        The frames, :math:`(3, H, W)` float32 in [0, 1], with ``size`` (H, W), ``frame_rate`` (a Fraction) and
        ``num_frames`` (None where the file does not say; ``len`` is the same).

    Raises:
        FileNotFoundError: ``path`` does not exist.
        ImportError: ``path`` is a file and PyAV is not installed.
        ValueError: the file is no video, has no video stream or no frames, or names no rate; the folder has no images.
            While reading: the file is damaged or cut short, or a frame has another size than the first. A Matroska
            file that is cut short between two frames gives a UserWarning at the end of a pass.

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(f"{folder}/clip", torch.rand(3, 3, 8, 10), 30)
        ...     video = read_video(f"{folder}/clip", frame_rate=30)
        ...     frames = list(video)
        >>> video.size, video.frame_rate, len(video), tuple(frames[0].shape)
        ((8, 10), Fraction(30, 1), 3, (3, 8, 10))
    """
    rate = None if frame_rate is None else _check_rate(frame_rate)
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"no such file or folder: {file}")
    return ImageFolder(file, rate or Fraction(24)) if file.is_dir() else VideoFile(file, rate)


class LabelMapReader:
    """The label maps of a folder, read one at a time on each pass; `read_label_maps` makes it.

    An iterable of :math:`(H, W)` int64; every ``for`` starts anew, ``len`` says how many.

    Attributes:
        path: the folder.
        size: (height, width) of every map.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder
        self._files = list_files(folder, _LABEL_SUFFIXES, "label maps")
        height, width = load_labels(self._files[0], rgb_ids=True).shape
        self.size = (height, width)

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[Tensor]:
        for file in self._files:
            labels = load_labels(file, rgb_ids=True)
            check_same_size(file, labels, self.size, self._files[0])
            yield labels

    def __repr__(self) -> str:
        return (
            f"LabelMapReader({shorten(repr(str(self.path)), 100)}, {len(self)} maps, {self.size[1]} x {self.size[0]})"
        )


def read_label_maps(folder: str | os.PathLike[str]) -> LabelMapReader:
    """Open the label maps of the frames of a video, one file for each: an iterable that reads one at a time.

    Files are read in the order of their names, ``9.png`` before ``10.png``, as `load_labels` reads them with
    ``rgb_ids``: a colour has the same id, R + 256 G + 65536 B, in every frame.

    Args:
        folder: holds the label maps; other files are skipped.

    Returns:
        The maps, :math:`(H, W)` int64, with ``size`` (H, W) and ``len``.

    Raises:
        FileNotFoundError: ``folder`` does not exist.
        NotADirectoryError: ``folder`` is a file.
        ValueError: it holds no label maps. While reading: a map is damaged or has another size than the first.

    Example:
        >>> import tempfile, torch
        >>> from kcgs.data import save_labels
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for k in range(3):
        ...         save_labels(f"{folder}/{k:05d}.png", torch.full((2, 4), k))
        ...     maps = read_label_maps(folder)
        ...     len(maps), maps.size, [int(labels.max()) for labels in maps]
        (3, (2, 4), [0, 1, 2])
    """
    return LabelMapReader(Path(folder))


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[Any],
    frame_rate: float | Fraction,
    *,
    codec: str = "libx264",
    crf: float = 14,
    pixel_format: str | None = None,
    options: Mapping[str, str] | None = None,
) -> None:
    """Write frames as a video, whole or not at all; visually lossless by default.

    Values are clipped to [0, 1]. The file is BT.709 of limited range, and says so; an .mp4 or .mov can be played before
    it is read to the end. A path without a suffix becomes a folder of ``00000.png``, ``00001.png`` and on, 8 bits per
    channel exactly; it must not exist or be empty. The same frames give the same bytes: encoders run in one thread.

    Args:
        path: .mp4, .mkv, .mov, .webm or what else FFmpeg writes by suffix, in an existing folder; or no suffix.
        frames: :math:`(3, H, W)` each, all of one size; or a tensor :math:`(N, 3, H, W)`. One is held at a time.
        frame_rate: frames per second, above 0.
        codec: an encoder of PyAV: "libx264", "libx265", "libsvtav1", "libvpx-vp9", "ffv1" (lossless, .mkv).
        crf: constant quality as the encoder counts it, 0 the best; 14 is visually lossless for x264.
        pixel_format: planar YUV that the encoder takes. None: "yuv420p", which everything plays, for even sizes;
            "yuv444p" for odd ones, which many browsers and telephones do not play.
        options: more options of the encoder, as {"preset": "slow"}.

    Raises:
        FileExistsError: ``path`` is a folder that holds something.
        FileNotFoundError: the folder of ``path`` does not exist.
        ImportError: PyAV is not installed (``pip install 'kcgs[video]'``).
        TypeError: a frame is no image.
        ValueError: there are no frames; one has another shape than the first, or values that are not finite; the
            encoder is not there, or refuses the settings or the size; the suffix is unknown.

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(f"{folder}/clip", [torch.zeros(3, 8, 10)] * 2, frame_rate=24)
        ...     sorted(file.name for file in Path(f"{folder}/clip").iterdir())
        ['00000.png', '00001.png']
    """
    rate = _check_rate(frame_rate)
    images = _checked(frames)
    if not Path(path).suffix:
        with _atomic_folder(Path(path)) as folder:
            for number, image in enumerate(images):
                save_image(folder / f"{number:05d}.png", image)
        return
    check_number("crf", crf, 0, 255)
    _find_encoder(codec)
    own = _ONE_THREAD.get(codec, {}) | ({"crf": f"{crf:g}"} if codec.startswith("lib") else {}) | dict(options or {})
    with atomic_path(path) as temporary:
        _encode(temporary, Path(path), images, rate, codec, pixel_format, own)


def _encode(
    temporary: Path,
    path: Path,
    images: Iterator[Tensor],
    rate: Fraction,
    codec: str,
    pixel_format: str | None,
    options: dict[str, str],
) -> None:
    av = import_av()
    first = next(images)
    height, width = first.shape[-2:]
    chosen = pixel_format or ("yuv444p" if height % 2 or width % 2 else "yuv420p")
    _check_format(chosen, codec)
    faststart = {"movflags": "+faststart"} if path.suffix.lower() in (".mp4", ".mov", ".m4v") else {}
    if codec == "libsvtav1":
        os.environ.setdefault("SVT_LOG", "1")  # it writes its settings to standard error otherwise
    try:
        container = av.open(os.fspath(temporary), "w", options=faststart)
    except ValueError:
        raise ValueError(f"path must end in a suffix of video, as .mp4 or .mkv; got {str(path)!r}") from None
    try:
        with container:
            stream = container.add_stream(codec, rate=rate, options=options)
            stream.width, stream.height, stream.pix_fmt = width, height, chosen
            stream.codec_context.thread_count = 1
            tag_bt709(stream.codec_context)
            if codec == "libx265" and faststart:
                stream.codec_context.codec_tag = "hvc1"  # the tag that QuickTime plays
            for number, image in enumerate(chain([first], images)):
                frame = frame_from_rgb(image, chosen)
                frame.pts, frame.time_base = number, 1 / rate
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    except av.error.FFmpegError as error:
        setting = f"{width} x {height}, {chosen}, {codec} with {options}"
        raise ValueError(f"cannot write {path} ({setting}): {error.strerror}") from error


def _checked(frames: Iterable[Any]) -> Iterator[Tensor]:
    """Check frames as they come; at least one."""
    if not isinstance(frames, Iterable) or isinstance(frames, str | bytes):
        raise TypeError(f"frames must be an iterable of images (3, H, W); got {type(frames).__name__}")
    return _check_each(frames)


def _check_each(frames: Iterable[Any]) -> Iterator[Tensor]:
    first: Tensor | None = None
    for number, frame in enumerate(frames):
        image = as_image(f"frame {number}", frame, tolerance=float("inf"))
        first = image if first is None else first
        if image.shape[0] != 3 or image.shape != first.shape:
            wanted = "(3, H, W)" if image is first else tuple(first.shape)
            raise ValueError(f"frame {number} must have shape {wanted}; got {tuple(image.shape)}")
        yield image
    if first is None:
        raise ValueError("frames must hold at least one frame; got none")


def _check_rate(value: object) -> Fraction:
    if isinstance(value, Fraction):
        check_number("frame_rate", float(value), 0, 1000, above=True)
        return value.limit_denominator(65535)
    return Fraction(check_number("frame_rate", value, 0, 1000, above=True)).limit_denominator(65535)


def _find_encoder(codec: str) -> None:
    av = import_av()
    try:
        av.codec.Codec(codec, "w")
    except ValueError:
        raise ValueError(f"codec must be an encoder of the PyAV here, as libx264 or libsvtav1; got {codec!r}") from None


def _check_format(pixel_format: str, codec: str) -> None:
    av = import_av()
    kinds = av.codec.Codec(codec, "w").video_formats or []
    planar = [kind.name for kind in kinds if kind.name.startswith("yuv4") and not kind.is_big_endian]
    if pixel_format not in planar:
        text = ", ".join(planar) or "no planar YUV"
        raise ValueError(f"pixel_format must be one that {codec} takes ({text}); got {pixel_format!r}")


@contextmanager
def _atomic_folder(target: Path) -> Iterator[Path]:
    """Yield a new folder beside `target` that takes its place at the end; on any exception it is removed."""
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {target}: the folder {target.parent} does not exist")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise FileExistsError(f"cannot write {target}: it exists, expected a new or an empty folder")
    temporary = target.with_name(f".tmp-{uuid.uuid4().hex}")
    temporary.mkdir()
    try:
        yield temporary
        if target.exists():
            target.rmdir()
        os.replace(temporary, target)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
