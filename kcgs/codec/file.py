"""The container of the file `.kcgs`: a header, the label map and layers, each with its checksum (docs/format.md)."""

from __future__ import annotations

import binascii
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from .gaussians.quantize import ENERGIES, QPS
from .rangecoder import CodecError

MAGIC = b"kcgs"
VERSION = 1
MAP_MAGIC = b"kcgm"
"""What a file begins with that is a label map and no scene."""
# a decoder's memory: pixels of a map; Gaussians in all, and numbers of their colours
MOST_LABELS = 1 << 26
MOST_GAUSSIANS, MOST_COLORS = (1 << 21) - 1, 1 << 27
MOST_SIDE, MOST_CHANNELS, MOST_REGIONS = 1 << 20, 1 << 10, (1 << 24) - 1
_MOST_LAYERS = 128
# Gaussians that a layer of no bytes may hold
SPARE = 64
_HEADER_CRC, LAYER_CRC = 4, 2  # bytes


class Header(NamedTuple):
    """What a file says before its content."""

    size: tuple[int, int]
    channels: int
    qp: int
    regions: int = 1
    layers: tuple[tuple[int, int], ...] = ()  # highest energy, bytes


class ByteReader:
    """Takes bytes and varints from the front; refuses to go beyond the end."""

    def __init__(self, data: bytes) -> None:
        self.data, self.position = data, 0

    def take(self, count: int) -> bytes:
        """Return the next bytes."""
        if count > len(self.data) - self.position:
            raise CodecError(f"the file ends early: it has {len(self.data)} bytes")
        self.position += count
        return self.data[self.position - count : self.position]

    def varint(self, name: str, low: int, high: int) -> int:
        """Return the next number, which must be in [low, high]."""
        value = shift = 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
            if shift >= 35:
                raise CodecError(f"{name} must be in [{low}, {high}]; got a number of more than 35 bits")
        if not low <= value <= high:
            raise CodecError(f"{name} must be in [{low}, {high}]; got {value}")
        return value


def most_gaussians(channels: int) -> int:
    """Return how many Gaussians a file may hold."""
    return min(MOST_GAUSSIANS, MOST_COLORS // channels)


def pack(header: Header, region_map: bytes, layers: list[bytes]) -> bytes:
    """Put a file together."""
    numbers = [*header.size, header.channels, header.qp - QPS[0], header.regions]
    head = bytearray(MAGIC + bytes([VERSION]) + b"".join(map(varint, numbers)))
    if header.regions > 1:
        head += varint(len(region_map))
    head += varint(len(layers))
    last = ENERGIES[1]
    for (energy, _), layer in zip(header.layers, layers, strict=True):
        head += varint(last - energy) + varint(len(layer))
        last = energy
    checksum = zlib.crc32(region_map, zlib.crc32(head)).to_bytes(_HEADER_CRC, "big")
    checked = [layer + binascii.crc_hqx(layer, 0).to_bytes(LAYER_CRC, "big") for layer in layers]
    return b"".join([head, checksum, region_map, *checked])


def unpack(data: bytes) -> tuple[Header, bytes, list[bytes]]:
    """Take a file apart: its header, its map, and the layers that are whole."""
    stream = ByteReader(data)
    header, length = _read_header(stream)
    head = stream.data[: stream.position]
    expected = int.from_bytes(stream.take(_HEADER_CRC), "big")
    region_map = stream.take(length)
    if zlib.crc32(region_map, zlib.crc32(head)) != expected:
        raise CodecError("the file is damaged: the checksum of its header and map is another")
    layers = list(_read_layers(stream, header))
    if not layers:
        raise CodecError(f"the file ends early: {len(data)} bytes hold no layer")
    return header, region_map, layers


def _read_layers(stream: ByteReader, header: Header) -> Iterator[bytes]:
    for number, (_, length) in enumerate(header.layers, 1):
        start = stream.position
        if start + length + LAYER_CRC > len(stream.data):
            return
        layer = stream.take(length)
        if binascii.crc_hqx(layer, 0) != int.from_bytes(stream.take(LAYER_CRC), "big"):
            sound = f"; its first {start} bytes are sound" if number > 1 else ""
            raise CodecError(f"the file is damaged: the checksum of its layer {number} is another{sound}")
        yield layer
    if stream.position != len(stream.data):
        raise CodecError(f"the file must end after {stream.position} bytes; got {len(stream.data)}")


def _read_header(stream: ByteReader) -> tuple[Header, int]:
    """Read the header; return it and the length of the map."""
    if (magic := stream.take(4)) == MAP_MAGIC:
        raise CodecError(
            "it is a label map, no scene: kcgs decode writes it as .png or .npy, kcgs.codec.decode_labels reads it"
        )
    if magic != MAGIC:
        raise CodecError(f"it must start with {MAGIC!r}; got {stream.data[:4]!r}")
    if (version := stream.take(1)[0]) != VERSION:
        raise CodecError(f"its version must be {VERSION}; got {version}")
    size = stream.varint("height", 1, MOST_SIDE), stream.varint("width", 1, MOST_SIDE)
    channels = stream.varint("channels", 1, MOST_CHANNELS)
    qp = stream.varint("quantization parameter", 0, QPS[1] - QPS[0]) + QPS[0]
    regions = stream.varint("regions", 1, MOST_REGIONS)
    length = 0
    if regions > 1:
        if size[0] * size[1] > MOST_LABELS:
            raise CodecError(f"an image with regions must have at most {MOST_LABELS} pixels; got {size}")
        length = stream.varint("length of the map", 1, 1 << 32)  # bytes that are not there end the file early
    count = stream.varint("layers", 1, _MOST_LAYERS)
    layers, energy = [], ENERGIES[1]
    for _ in range(count):
        energy -= stream.varint("energy", 0, energy - ENERGIES[0])
        layers.append((energy, stream.varint("length of a layer", 1, 1 << 32)))
    return Header(size, channels, qp, regions, tuple(layers)), length


def varint(value: int) -> bytes:
    """Return a number, 0 or more, in seven bits per byte, low ones first."""
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
