"""The container of a clip: a header, then records, each with its checksum (docs/format.md)."""

from __future__ import annotations

import zlib
from fractions import Fraction
from typing import NamedTuple

from kcgs.codec.file import CLIP_VERSION, MAGIC, MOST_CHANNELS, MOST_SIDE, ByteReader, EndsEarly, varint
from kcgs.codec.rangecoder import CodecError

KEY, CARRIED, END = range(3)
_CRC = 4  # bytes
_MOST_RATE, _MOST_BYTES, _MOST_FRAMES = 1 << 20, 1 << 32, 1 << 30


class ClipHeader(NamedTuple):
    """What a clip says before its frames."""

    size: tuple[int, int]
    channels: int
    frame_rate: Fraction


class Record(NamedTuple):
    """A frame as bytes: a still file, or what changed since the frame before."""

    kind: int
    data: bytes


def pack_header(header: ClipHeader) -> bytes:
    """Return the beginning of a clip."""
    numbers = *header.size, header.channels, header.frame_rate.numerator, header.frame_rate.denominator
    head = MAGIC + bytes([CLIP_VERSION]) + b"".join(map(varint, numbers))
    return head + zlib.crc32(head).to_bytes(_CRC, "big")


def pack_record(record: Record, number: int) -> bytes:
    """Return a record, the `number`-th of its clip from 0: its checksum knows where it belongs."""
    head = varint(record.kind) + varint(len(record.data))
    return head + record.data + _checksum(head, record.data, number)


def pack_end(count: int) -> bytes:
    """Return what follows the last of `count` frames."""
    return pack_record(Record(END, b""), count)


def is_clip(data: bytes) -> bool:
    """Say whether a file holds frames."""
    return data[: len(MAGIC)] == MAGIC and data[len(MAGIC) : len(MAGIC) + 1] == bytes([CLIP_VERSION])


def unpack(data: bytes) -> tuple[ClipHeader, list[Record], bool]:
    """Take a clip apart: its header, the frames that are whole, and whether it ends where it should.

    Raises:
        CodecError: it is no clip, or damaged.
    """
    stream = ByteReader(data)
    if stream.take(len(MAGIC)) != MAGIC:
        raise CodecError(f"it must start with {MAGIC!r}; got {data[:4]!r}")
    if (version := stream.take(1)[0]) != CLIP_VERSION:
        raise CodecError(f"a clip has version {CLIP_VERSION}; got {version}")
    size = stream.varint("height", 1, MOST_SIDE), stream.varint("width", 1, MOST_SIDE)
    channels = stream.varint("channels", 1, MOST_CHANNELS)
    rate = stream.varint("frame rate", 1, _MOST_RATE), stream.varint("seconds of the frame rate", 1, _MOST_RATE)
    head = data[: stream.position]
    if zlib.crc32(head).to_bytes(_CRC, "big") != stream.take(_CRC):
        raise CodecError("the file is damaged: the checksum of its header is another")
    header = ClipHeader(size, channels, Fraction(*rate))
    records: list[Record] = []
    while len(records) < _MOST_FRAMES:
        record = _read_record(stream, len(records))
        if record is None:
            return header, records, False
        if record.kind == END:
            if stream.position != len(data):
                raise CodecError(f"the clip must end after {stream.position} bytes; got {len(data)}")
            return header, records, True
        if not records and record.kind != KEY:
            raise CodecError("the first frame of a clip must be a key frame")
        records.append(record)
    raise CodecError(f"a clip must hold at most {_MOST_FRAMES} frames")


def _read_record(stream: ByteReader, number: int) -> Record | None:
    """Return the next record, or None where the file ends within it."""
    start = stream.position
    try:
        kind = stream.varint("kind of a record", KEY, END)
        length = stream.varint("length of a record", 0, _MOST_BYTES)
        head = stream.data[start : stream.position]
        content, checksum = stream.take(length), stream.take(_CRC)
    except EndsEarly:
        return None
    if checksum != _checksum(head, content, number):
        raise CodecError(f"the file is damaged: the checksum of frame {number} is another")
    return Record(kind, content)


def _checksum(head: bytes, content: bytes, number: int) -> bytes:
    return zlib.crc32(content, zlib.crc32(head, zlib.crc32(varint(number)))).to_bytes(_CRC, "big")
