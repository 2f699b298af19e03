"""Label maps as files of their own, without loss (docs/format.md)."""

from __future__ import annotations

import zlib
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count, check_labels

from .file import MAGIC, MAP_MAGIC, MOST_LABELS, MOST_SIDE, ByteReader, varint
from .rangecoder import CodecError

VERSION = 1
_TURNS, _CRC = 8, 4  # ways to turn a map; bytes
_TYPES = ("bool", "uint8", "int8", "uint16", "int16", "uint32", "int32", "int64")


def encode_labels(labels: Tensor | NDArray[Any]) -> bytes:
    """Write a label map as a `.kcgs` file; nothing is lost, and the same map gives the same bytes.

    Args:
        labels: :math:`(H, W)` integer or bool, ids of 0 to 2**63 - 1; a numpy array will do. At most 2**26 pixels,
            2**20 on a side, and fewer than 2**24 regions.

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
        labels = labels.cpu().numpy()  # of which torch has no minimum
    ids = check_labels("labels", labels, dims=(2,))
    dtype = str(labels.dtype).removeprefix("torch.").replace("uint64", "int64")
    check_count("pixels per side of labels", max(ids.shape), 1, MOST_SIDE)
    check_count("pixels of labels", ids.numel(), 1, MOST_LABELS)
    from .labels.coding import encode_turned  # loads numba

    turn, stream = encode_turned(ids.cpu().numpy())
    form = turn + _TURNS * (_TYPES.index(dtype) + len(_TYPES) * (VERSION - 1))
    data = b"".join([MAP_MAGIC, bytes([form]), *map(varint, ids.shape), stream])
    return data + zlib.crc32(data).to_bytes(_CRC, "big")


def decode_labels(data: bytes) -> Tensor:
    """Read a label map that :func:`encode_labels` wrote.

    Args:
        data: the whole file.

    Returns:
        :math:`(H, W)` on the CPU, in the dtype that was given; of uint64, int64.

    Raises:
        TypeError: ``data`` is no bytes.
        CodecError: a ValueError; the file is damaged, ends early, or holds no label map.

    Example:
        >>> decode_labels(encode_labels(torch.arange(6).view(2, 3) * 1_000_000))
        tensor([[      0, 1000000, 2000000],
                [3000000, 4000000, 5000000]])
    """
    return decode_with_ids(data)[0]


def decode_with_ids(data: bytes) -> tuple[Tensor, NDArray[Any]]:
    """Return a file's label map, and the ids in it."""
    if not isinstance(data, bytes | bytearray | memoryview):
        raise TypeError(f"data must be bytes; got {type(data).__name__}")
    data = bytes(data)
    content, checksum = data[:-_CRC], data[-_CRC:]
    if not data.startswith(MAP_MAGIC):
        what = "a scene, which kcgs.codec.decode reads" if data.startswith(MAGIC) else f"{data[:4]!r}"
        raise CodecError(f"data must be a label map, which starts with {MAP_MAGIC!r}; got {what}")
    if len(data) < len(MAP_MAGIC) + _CRC or zlib.crc32(content) != int.from_bytes(checksum, "big"):
        raise CodecError("the file is damaged or ends early: its checksum is another")
    reader = ByteReader(content[len(MAP_MAGIC) :])
    version, form = divmod(reader.take(1)[0], _TURNS * len(_TYPES))
    if version + 1 != VERSION:
        raise CodecError(f"its version must be {VERSION}; got {version + 1}")
    height, width = reader.varint("height", 1, MOST_SIDE), reader.varint("width", 1, MOST_SIDE)
    if height * width > MOST_LABELS:
        raise CodecError(f"a map must have at most {MOST_LABELS} pixels; got {height} x {width}")
    from .labels.coding import decode_turned  # loads numba

    stream, dtype = reader.data[reader.position :], _TYPES[form // _TURNS]
    labels, ids = decode_turned(stream, (height, width), form % _TURNS, dtype)
    return torch.from_numpy(labels), ids
