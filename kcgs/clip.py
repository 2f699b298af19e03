"""Clip: the scenes of a video, one after another, as its file holds them."""

from __future__ import annotations

import math
import os
from bisect import bisect_right
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

from torch import Tensor

from kcgs._atomic import write_file
from kcgs._check import check_number
from kcgs.codec.clips.between import between
from kcgs.codec.clips.carried import ClipPart, Frame
from kcgs.codec.clips.file import KEY, ClipHeader, Record, pack_end, pack_header, pack_record, unpack
from kcgs.codec.clips.frames import FrameReader
from kcgs.codec.clips.rewriting import ClipWriter, asked_of
from kcgs.codec.rangecoder import CodecError
from kcgs.scene import Scene


class Clip(Sequence[Scene]):
    r"""Scenes one after another.

    It holds the bytes of its file, and decodes a frame when it is asked for one: a frame after the last one takes some
    hundredths of a second, any other one as many as there are since its key frame. Gaussians keep their identity from
    frame to frame, so that a clip can be rendered in between.

    Args:
        header: size, channels and frame rate.
        records: its frames, the first a key frame.

    Example:
        >>> import torch
        >>> from kcgs import fit_video
        >>> x = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> clip = fit_video([x, x.roll(2, 2)], num_gaussians=30, iterations=30)
        >>> len(clip), clip[1].render().shape, clip.render(0.5, size=(64, 96)).shape
        (2, torch.Size([3, 32, 48]), torch.Size([3, 64, 96]))
    """

    def __init__(self, header: ClipHeader, records: list[Record]) -> None:
        self._header, self._records = header, list(records)
        self._reader, self._next = FrameReader(header), 0
        # the last two frames that were read, by number: times between them need both
        self._recent: dict[int, tuple[ClipPart, Frame]] = {}
        self._keys = tuple(number for number, record in enumerate(self._records) if record.kind == KEY)
        if not self._keys or self._keys[0]:
            raise ValueError("records must begin with a key frame")

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self._header.size

    @property
    def frame_rate(self) -> Fraction:
        """Frames per second."""
        return self._header.frame_rate

    @property
    def key_frames(self) -> tuple[int, ...]:
        """Numbers of the frames that need no other."""
        return self._keys

    @property
    def frame_bytes(self) -> tuple[int, ...]:
        """Bytes of each frame in the file."""
        return tuple(len(pack_record(record, number)) for number, record in enumerate(self._records))

    @property
    def num_bytes(self) -> int:
        """Bytes of the file."""
        return len(pack_header(self._header)) + sum(self.frame_bytes) + len(pack_end(len(self)))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._records)

    def __getitem__(self, number: int) -> Scene:  # type: ignore[override]
        """Return a frame, from 0; negative numbers count from the end."""
        if not isinstance(number, int) or isinstance(number, bool):
            raise TypeError(f"the number of a frame must be an int; got {number!r}")
        if not -len(self) <= number < len(self):
            raise IndexError(f"a frame of this clip must be {-len(self)} to {len(self) - 1}; got {number}")
        part, frame = self._frame(number % len(self))
        return part.scene(frame)

    def at(self, time: float) -> Scene:
        """Return the scene at a time between frames: 0.5 is halfway between the first two.

        Gaussians that both frames have are on their way, the others fade; contours move with their regions. Before a
        key frame, whose Gaussians are others, the nearer of the two frames is returned.

        Args:
            time: in frames, 0 to the number of the last one.

        Raises:
            TypeError, ValueError: no number, or out of range.
        """
        time = check_number("time", time, 0.0, len(self) - 1.0, unit="frames")
        number = math.floor(time)
        share = time - number
        if share == 0.0:
            return self[number]
        if self._records[number + 1].kind == KEY:
            return self[round(time)]
        _, first = self._frame(number)
        part, second = self._frame(number + 1)
        return part.scene(between(first, second, share, self.size))

    def render(self, time: float, size: tuple[int, int] | None = None, contours: str = "scaled") -> Tensor:
        """Render a time, as :meth:`at` has it: (C, H, W) in [0, 1], without a graph; see :meth:`kcgs.Scene.render`."""
        return self.at(time).render(size, contours)

    def edit(self, function: Callable[[Scene], Scene]) -> Clip:
        """Return a clip with every frame edited, such as by a function of :mod:`kcgs.editing`.

        Frames stay key frames or carried ones, and as fine as they were. Gaussians of successive frames that are nearly
        the same are taken for the same; the images of the video are not needed.

        Args:
            function: from a scene to one of the same size.

        Raises:
            TypeError, ValueError: it does not return a scene, or one of another size, or what a file cannot hold.

        Example:
            >>> import torch
            >>> from kcgs import fit_video
            >>> from kcgs.editing import recolor_region
            >>> labels = (torch.arange(48) >= 24).long().expand(32, 48)
            >>> frames = [0.3 + 0.4 * labels.expand(3, 32, 48)] * 2
            >>> clip = fit_video(frames, labels, num_gaussians=20, iterations=30)
            >>> red = clip.edit(lambda scene: recolor_region(scene, 1, (1, 0, 0)))
            >>> bool(red[1].render()[0, 16, 40] > 0.6), bool(red[1].render()[2, 16, 40] < 0.1)
            (True, True)
        """
        writer, records = ClipWriter(), []
        for number, (asked, scene) in enumerate(asked_of(self._records, self._header)):
            try:
                edited = function(scene)
            except (TypeError, ValueError) as error:
                raise type(error)(f"frame {number}: {error}") from error
            if not isinstance(edited, Scene):
                raise TypeError(f"function must return a Scene; got {type(edited).__name__} for frame {number}")
            if edited.size != self.size or edited.field.colors.shape[-1] != self._header.channels:
                raise ValueError(f"function must keep the size {self.size}; got {edited!r} for frame {number}")
            records.append(writer.add(edited, asked))
        return Clip(self._header, records)

    def _frame(self, number: int) -> tuple[ClipPart, Frame]:
        """Return a frame, and the part of the clip that it is of."""
        if number in self._recent:
            return self._recent[number]
        key = self._keys[bisect_right(self._keys, number) - 1]
        if not key < self._next <= number + 1:  # what was read last is no way to this one
            self._next = key
            self._recent.clear()
        while self._next <= number:
            try:
                frame = self._reader.read(self._records[self._next])
            except BaseException as error:  # what the reader has learned is of half a frame
                failed, self._next = self._next, 0
                self._recent.clear()
                if isinstance(error, CodecError):
                    raise CodecError(f"frame {failed}: {error}") from error
                raise
            assert self._reader.part is not None
            self._recent.pop(self._next - 2, None)
            self._recent[self._next] = self._reader.part, frame
            self._next += 1
        return self._recent[number]

    def to_bytes(self) -> bytes:
        """Return the file."""
        records = (pack_record(record, number) for number, record in enumerate(self._records))
        return b"".join([pack_header(self._header), *records, pack_end(len(self))])

    @classmethod
    def from_bytes(cls, data: bytes, *, whole: bool = True) -> Clip:
        """Read a clip; with `whole` False also one that ends early: its whole frames."""
        header, records, ended = unpack(data)
        if not records:
            raise CodecError("the clip ends early: it holds no whole frame")
        if whole and not ended:
            way = "kcgs decode --bytes, or whole=False, reads these"
            raise CodecError(f"the clip ends early, after {len(records)} whole frames: {way}")
        return cls(header, records)

    def save(self, path: str | os.PathLike[str]) -> int:
        """Write the clip as a `.kcgs` file, whole or not at all; return its bytes."""
        if Path(path).suffix != ".kcgs":
            raise ValueError(f"path must end in .kcgs; got {str(path)!r}")
        return write_file(path, self.to_bytes())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Clip:
        """Read a clip from a `.kcgs` file."""
        try:
            return cls.from_bytes(Path(path).read_bytes())
        except ValueError as error:
            raise ValueError(f"cannot load {path}: {error}") from error

    def __repr__(self) -> str:
        height, width = self.size
        keys = len(self.key_frames)
        return (
            f"Clip({len(self)} frames of {width} x {height}, {float(self.frame_rate):g} per second, {keys} key "
            f"frame{'s' * (keys > 1)}, {self.num_bytes} bytes)"
        )
