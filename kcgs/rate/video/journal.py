"""The frames of a clip that is being fitted, on disk, so that a stopped fit can go on."""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from pathlib import Path
from typing import Any

from torch import Tensor

from kcgs._atomic import check_writable, write_file
from kcgs.codec.clips.file import ClipHeader, Record, pack_header, pack_record, unpack
from kcgs.codec.rangecoder import CodecError

_SUM = 4  # bytes


class Journal:
    """A file that frames are added to: a line that says of which fit, then a clip without its end.

    Each of its records begins with a checksum of the frame and the map that were given.

    Args:
        path: the file.
        asked: arguments of the fit, which JSON can write.
        resume: go on from what is there.
    """

    def __init__(self, path: str | os.PathLike[str], asked: dict[str, Any], *, resume: bool) -> None:
        check_writable("checkpoint", path)
        self._path, self._asked = Path(path), asked
        self._kept: tuple[ClipHeader, list[Record]] | None = None
        self._started = False
        if resume and self._path.exists():
            self._read()

    def done(self, header: ClipHeader, number: int, image: Tensor, labels: Tensor | None) -> Record | None:
        """Return a frame that was fitted before; the first that was not ends what is there."""
        if self._kept is None or number >= len(self._kept[1]):
            return None
        if self._kept[0] != header:
            raise ValueError(f"checkpoint {str(self._path)!r} is of another video: {self._kept[0]}, not {header}")
        kind, data = self._kept[1][number]
        if data[:_SUM] != _sum(image, labels):
            raise ValueError(f"checkpoint {str(self._path)!r} is of another video: frame {number} or its map differs")
        return Record(kind, data[_SUM:])

    def write(self, header: ClipHeader, number: int, image: Tensor, labels: Tensor | None, record: Record) -> None:
        """Add a frame."""
        if not self._started:
            whole = [] if self._kept is None else self._kept[1]
            content = self._line() + pack_header(header)
            content += b"".join(pack_record(one, place) for place, one in enumerate(whole))
            write_file(self._path, content)
            self._started = True
        with self._path.open("ab") as file:
            file.write(pack_record(Record(record.kind, _sum(image, labels) + record.data), number))
            file.flush()
            os.fsync(file.fileno())

    def _line(self) -> bytes:
        digest = hashlib.sha256(json.dumps(self._asked, sort_keys=True, default=str).encode()).hexdigest()
        return f"kcgs.video {digest}\n".encode()

    def _read(self) -> None:
        data = self._path.read_bytes()
        line = self._line()
        if not data.startswith(b"kcgs.video "):
            raise ValueError(f"checkpoint {str(self._path)!r} is no checkpoint of a video")
        if not data.startswith(line):
            raise ValueError(f"checkpoint {str(self._path)!r} is of a fit with other arguments")
        try:
            header, records, _ = unpack(data[len(line) :])
        except CodecError as error:
            raise ValueError(f"checkpoint {str(self._path)!r} cannot be read: {error}") from error
        self._kept = header, records


def _sum(image: Tensor, labels: Tensor | None) -> bytes:
    """Return the checksum of a frame and its map."""
    found = zlib.crc32(image.detach().cpu().contiguous().numpy().tobytes())
    if labels is not None:
        found = zlib.crc32(labels.cpu().contiguous().numpy().tobytes(), found)
    return found.to_bytes(_SUM, "big")
