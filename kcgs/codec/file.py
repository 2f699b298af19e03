"""The container of a `.kcgs` file: header, label map and layers, with their checksums (docs/format.md)."""

from __future__ import annotations

import binascii
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from .gaussians.quantize import ENERGIES, QPS
from .rangecoder import CodecError

MAGIC = b"kcgs"  # first bytes of the file of a scene
MAP_MAGIC = b"kcgm"  # first bytes of the file of a label map
VERSION = 1
# limits on the memory of a decoder
MAX_SIDE = 1 << 20  # pixels
MAX_CHANNELS = 1 << 10
MAX_REGIONS = (1 << 24) - 1
MAX_LABELS = 1 << 26  # pixels of a label map
MAX_GAUSSIANS = (1 << 21) - 1
MAX_COLORS = 1 << 27  # values of all colours: Gaussians times channels
_MAX_LAYERS = 128
_MAX_BYTES = 1 << 32  # largest size of a map or a layer
_VARINT_BITS = 35  # bits of the longest varint, five bytes
_HEADER_CRC = 4  # bytes
LAYER_CRC = 2  # bytes


class Header(NamedTuple):
    """The numbers at the start of a file."""

    size: tuple[int, int]
    channels: int
    qp: int  # quantization parameter
    regions: int = 1
    layers: tuple[tuple[int, int], ...] = ()  # of each layer: highest class of energy, bytes


def max_gaussians(channels: int) -> int:
    """Return the largest number of Gaussians in a file."""
    return min(MAX_GAUSSIANS, MAX_COLORS // channels)


def pack(header: Header, region_map: bytes, layers: list[bytes]) -> bytes:
    """Join a header, a map and layers into a file."""
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


def varint(value: int) -> bytes:
    """Return a number, 0 or more, in seven bits per byte, the low bits first."""
    data = bytearray()
    while value > 127:
        data.append(value & 127 | 128)
        value >>= 7
    return bytes([*data, value])


def unpack(data: bytes) -> tuple[Header, bytes, list[bytes]]:
    """Split a file into its header, its map, and its complete layers."""
    reader = ByteReader(data)
    header, map_length = _read_header(reader)
    head = reader.data[: reader.position]
    checksum = int.from_bytes(reader.take(_HEADER_CRC), "big")
    region_map = reader.take(map_length)
    if zlib.crc32(region_map, zlib.crc32(head)) != checksum:
        raise CodecError("the file is damaged: the checksum of its header and map is wrong")
    layers = list(_read_layers(reader, header))
    if not layers:
        raise CodecError(f"the file ends early: {len(data)} bytes hold no layer")
    return header, region_map, layers


def _read_header(reader: ByteReader) -> tuple[Header, int]:
    """Read the header; return it and the length of the map in bytes."""
    if (magic := reader.take(len(MAGIC))) == MAP_MAGIC:
        raise CodecError(
            "it is a label map, no scene: kcgs decode writes it as .png or .npy, kcgs.codec.decode_labels reads it"
        )
    if magic != MAGIC:
        raise CodecError(f"it must start with {MAGIC!r}; got {magic!r}")
    if (version := reader.take(1)[0]) != VERSION:
        raise CodecError(f"its version must be {VERSION}; got {version}")
    size = reader.varint("height", 1, MAX_SIDE), reader.varint("width", 1, MAX_SIDE)
    channels = reader.varint("channels", 1, MAX_CHANNELS)
    qp = reader.varint("quantization parameter", 0, QPS[1] - QPS[0]) + QPS[0]
    regions = reader.varint("regions", 1, min(MAX_REGIONS, size[0] * size[1]))
    map_length = 0
    if regions > 1:
        if size[0] * size[1] > MAX_LABELS:
            raise CodecError(f"an image with regions must have at most {MAX_LABELS} pixels; got {size}")
        map_length = reader.varint("length of the map", 1, _MAX_BYTES)
    num_layers = reader.varint("layers", 1, _MAX_LAYERS)
    layers, energy = [], ENERGIES[1]
    for _ in range(num_layers):
        energy -= reader.varint("energy", 0, energy - ENERGIES[0])
        layers.append((energy, reader.varint("length of a layer", 1, _MAX_BYTES)))
    return Header(size, channels, qp, regions, tuple(layers)), map_length


def _read_layers(reader: ByteReader, header: Header) -> Iterator[bytes]:
    for number, (_, length) in enumerate(header.layers, 1):
        start = reader.position
        if start + length + LAYER_CRC > len(reader.data):
            return
        layer = reader.take(length)
        if binascii.crc_hqx(layer, 0) != int.from_bytes(reader.take(LAYER_CRC), "big"):
            intact = f"; its first {start} bytes are intact" if number > 1 else ""
            raise CodecError(f"the file is damaged: the checksum of its layer {number} is wrong{intact}")
        yield layer
    if reader.position != len(reader.data):
        raise CodecError(f"the file must end after {reader.position} bytes; got {len(reader.data)}")


class ByteReader:
    """Read bytes and varints from the front, never beyond the end."""

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
            if shift >= _VARINT_BITS:
                raise CodecError(f"{name} must be in [{low}, {high}]; got a number of more than {_VARINT_BITS} bits")
        if not low <= value <= high:
            raise CodecError(f"{name} must be in [{low}, {high}]; got {value}")
        return value
