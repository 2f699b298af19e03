"""The frames of a clip as records, and back."""

from __future__ import annotations

from kcgs.codec.exact import Integers
from kcgs.codec.file import ByteReader, unpack, varint
from kcgs.codec.gaussians.quantize import QPS
from kcgs.codec.rangecoder import CodecError, Reader, Writer
from kcgs.codec.scenes import deserialize
from kcgs.scene import Scene

from .carried import Change, ClipPart, Frame
from .file import CARRIED, KEY, ClipHeader, Record


def key_record(still: bytes) -> Record:
    """Return the record of a key frame, of a still file."""
    return Record(KEY, still)


def carried_record(part: ClipPart, qp: int, numbers: Integers, change: Change) -> Record:
    """Write the next frame of a part, which goes on to it."""
    writer = Writer()
    part.code(writer, qp, numbers, change)
    return Record(CARRIED, varint(qp - QPS[0]) + writer.finish())


class FrameReader:
    """Reads frames one after another: each key frame begins a part, which the others go on."""

    def __init__(self, header: ClipHeader) -> None:
        self.header = header
        self.part: ClipPart | None = None

    def read(self, record: Record) -> Frame:
        """Return the next frame.

        Raises:
            CodecError: the record is no frame of this clip.
        """
        if record.kind == KEY:
            still = deserialize(record.data)
            found = still.size, still.field.colors.shape[-1]
            if found != (self.header.size, self.header.channels):
                raise CodecError(
                    f"a key frame must be {self.header.size}, {self.header.channels} channels; got {found}"
                )
            try:
                self.part = begin_part(still, self.part)
            except CodecError:
                raise
            except ValueError as error:
                raise CodecError(str(error)) from error
            return self.part.frame
        if self.part is None:
            raise CodecError("a carried frame must follow a key frame")
        return read_carried(self.part, record)


def begin_part(still: Scene, last: ClipPart | None) -> ClipPart:
    """Return what begins with a key frame's scene; the Gaussians of the part before have other numbers."""
    return ClipPart(still, 0 if last is None else last.next_key)


def read_qp(record: Record) -> tuple[int, int]:
    """Return the quantization parameter of a frame, and where a carried one's stream begins."""
    if record.kind == KEY:
        return unpack(record.data)[0].qp, 0
    stream = ByteReader(record.data)
    return stream.varint("quantization parameter", 0, QPS[1] - QPS[0]) + QPS[0], stream.position


def read_carried(part: ClipPart, record: Record) -> Frame:
    """Read the next frame of a part, which goes on to it."""
    qp, start = read_qp(record)
    try:
        return part.code(Reader(record.data[start:]), qp, None, None)
    except CodecError:
        raise
    except (ValueError, OverflowError) as error:
        raise CodecError(f"the frame cannot be read: {error}") from error
