"""Lossless files of label maps (docs/format.md, "A file of a label map")."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count
from kcgs._labels import check_labels
from kcgs.errors import InvalidArgumentType
from kcgs.maps import compact

from .exact import Integers
from .file import MAGIC, MAP_MAGIC, MAX_LABELS, MAX_REGIONS, MAX_SIDE, ByteReader, varint
from .rangecoder import CodecError

_TYPES = ("bool", "uint8", "int8", "uint16", "int16", "uint32", "int32", "int64")
_CRC = 4  # bytes
_TURNS = 8  # ways to transpose and mirror a map
_TRIED_TURNS = 2  # turns that are coded; the smallest stream is written
_SEED_MARGIN = 3  # a turn is coded only if it has at most so many seeds more than the best turn


def encode_labels(labels: Tensor | NDArray[Any]) -> bytes:
    """Write a label map as a `.kcgs` file; nothing is lost, and the same map gives the same bytes.

    Args:
        labels: :math:`(H, W)` integer or bool, Tensor or numpy array, ids from 0 to 2**63 - 1. A file holds at most
            2**26 pixels, 2**20 pixels on a side, and fewer than 2**24 regions.

    Returns:
        The file. A photo's segmentation takes a few hundred bytes.

    Raises:
        TypeError: ``labels`` is no integer tensor or array.
        ValueError: another shape, negative ids, or more than a file may hold.

    Example:
        >>> labels = torch.tensor([[0, 0, 255], [0, 255, 255]], dtype=torch.uint8)
        >>> data = encode_labels(labels)
        >>> len(data), torch.equal(decode_labels(data), labels), decode_labels(data).dtype
        (14, True, torch.uint8)
    """
    if isinstance(labels, Tensor) and labels.dtype == torch.uint64:
        labels = labels.cpu().numpy()  # torch has no minimum of uint64
    checked = check_labels("labels", labels, dims=(2,))
    dtype = str(labels.dtype).removeprefix("torch.").replace("uint64", "int64")
    check_count("pixels per side of labels", max(checked.shape), 1, MAX_SIDE)
    check_count("pixels of labels", checked.numel(), 1, MAX_LABELS)
    ids, index = (numbers.numpy() for numbers in compact(checked.cpu()))
    check_count("number of regions", len(ids), 1, MAX_REGIONS)
    turn, stream = _encode_smallest(ids, index)
    form = turn + _TURNS * _TYPES.index(dtype)
    data = b"".join([MAP_MAGIC, bytes([form]), *map(varint, checked.shape), stream])
    return data + zlib.crc32(data).to_bytes(_CRC, "big")


def _encode_smallest(ids: Integers, index: NDArray[Any]) -> tuple[int, bytes]:
    """Return the turn of a map that takes the fewest bytes of those tried, and its stream."""
    from .labels.stream import encode_stream  # loads numba
    from .labels.wavefront import order_regions

    # as a rule, a turn with fewer seeds has a smaller stream
    seeds = [int(order_regions(turned(index, turn), len(ids))[1].sum()) for turn in range(_TURNS)]
    fewest = sorted(range(_TURNS), key=seeds.__getitem__)[:_TRIED_TURNS]
    turns = [turn for turn in fewest if seeds[turn] <= min(seeds) + _SEED_MARGIN]
    streams = [(turn, encode_stream(ids, turned(index, turn), is_file=True)) for turn in turns]
    return min(streams, key=lambda pair: len(pair[1]))


def turned(labels: NDArray[Any], turn: int) -> NDArray[Any]:
    """Transpose a map if `turn` has bit 4, reverse its rows for bit 2, then its columns for bit 1."""
    labels = labels.T if turn & 4 else labels
    return np.ascontiguousarray(labels[:: -1 if turn & 2 else 1, :: -1 if turn & 1 else 1])


def turned_back(labels: NDArray[Any], turn: int) -> NDArray[Any]:
    """Undo `turned`: return a view of the original map."""
    labels = labels[:: -1 if turn & 2 else 1, :: -1 if turn & 1 else 1]
    return labels.T if turn & 4 else labels


def decode_labels(data: bytes) -> Tensor:
    """Read a label map that :func:`encode_labels` wrote.

    Args:
        data: the whole file.

    Returns:
        :math:`(H, W)` on the CPU, in the dtype that was encoded; int64 for uint64.

    Raises:
        TypeError: ``data`` is no bytes.
        CodecError: a ValueError; the file is damaged, ends early, or holds no label map.

    Example:
        >>> decode_labels(encode_labels(torch.arange(6).view(2, 3) * 1_000_000))
        tensor([[      0, 1000000, 2000000],
                [3000000, 4000000, 5000000]])
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise InvalidArgumentType("data", "bytes", type(data).__name__)
    data = bytes(data)
    content, checksum = data[:-_CRC], data[-_CRC:]
    if not data.startswith(MAP_MAGIC):
        content_name = "a scene, which kcgs.codec.decode reads" if data.startswith(MAGIC) else f"{data[:4]!r}"
        raise CodecError(f"data must be a label map, which starts with {MAP_MAGIC!r}; got {content_name}")
    if len(data) < len(MAP_MAGIC) + _CRC or zlib.crc32(content) != int.from_bytes(checksum, "big"):
        raise CodecError("the file is damaged or ends early: its checksum is wrong")
    reader = ByteReader(content[len(MAP_MAGIC) :])
    form = reader.take(1)[0]
    if form >= _TURNS * len(_TYPES):
        raise CodecError(f"turn and type must be below {_TURNS * len(_TYPES)}; got {form}")
    type_index, turn = divmod(form, _TURNS)
    height, width = reader.varint("height", 1, MAX_SIDE), reader.varint("width", 1, MAX_SIDE)
    if height * width > MAX_LABELS:
        raise CodecError(f"a map must have at most {MAX_LABELS} pixels; got {height} x {width}")
    stream, size = reader.data[reader.position :], (width, height) if turn & 4 else (height, width)
    from .labels.stream import decode_ids, decode_numbers, label_pixels  # loads numba

    pixels, ids = decode_ids(stream, size, MAX_REGIONS, is_file=True)
    dtype = _TYPES[type_index]
    max_id = 1 if dtype == "bool" else np.iinfo(dtype).max
    if ids.max() > max_id:
        raise CodecError(f"ids of {dtype} must be at most {max_id}; got {ids.max()}")
    numbers = decode_numbers(pixels, size, len(ids), is_file=True)
    return torch.from_numpy(label_pixels(ids.astype(dtype), turned_back(numbers, turn)))
