"""Label maps as files of their own, without loss (docs/format.md)."""

from __future__ import annotations

import zlib
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count, check_labels

from .file import MAP_MAGIC, MOST_LABELS, MOST_SIDE, ByteReader, varint
from .rangecoder import CodecError

VERSION = 1
_TURNS, _CRC = 8, 4  # ways to turn a map; bytes
_TYPES = (torch.bool, torch.uint8, torch.int8, torch.uint16, torch.int16, torch.uint32, torch.int32, torch.int64)


def encode_labels(labels: Tensor | NDArray[Any]) -> bytes:
    """Write a label map as a `.kcgs` file; nothing is lost, and the same map gives the same bytes.

    Args:
        labels: :math:`(H, W)` integer or bool, any non-negative ids; a numpy array will do. At most 2**26 pixels, 2**20
            on a side, and fewer than 2**24 regions.

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
    ids = check_labels("labels", labels, dims=(2,))
    dtype = labels.dtype if isinstance(labels, Tensor) else getattr(torch, labels.dtype.name)
    if dtype not in _TYPES:
        raise TypeError(f"labels must have a dtype of at most 63 bits; got {dtype}")
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
        :math:`(H, W)` on the CPU, in the dtype that was given.

    Raises:
        TypeError: ``data`` is no bytes.
        CodecError: a ValueError; the file is damaged, ends early, or holds no label map.

    Example:
        >>> decode_labels(encode_labels(torch.arange(6).view(2, 3) * 1_000_000))
        tensor([[      0, 1000000, 2000000],
                [3000000, 4000000, 5000000]])
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise TypeError(f"data must be bytes; got {type(data).__name__}")
    content, checksum = bytes(data[:-_CRC]), bytes(data[-_CRC:])
    if not content.startswith(MAP_MAGIC):
        what = "a scene, which kcgs.codec.decode reads" if content.startswith(b"kcgs") else f"{content[:4]!r}"
        raise CodecError(f"data must be a label map, which starts with {MAP_MAGIC!r}; got {what}")
    if zlib.crc32(content) != int.from_bytes(checksum, "big"):
        raise CodecError("the file is damaged or ends early: its checksum is another")
    reader = ByteReader(content[len(MAP_MAGIC) :])
    version, form = divmod(reader.take(1)[0], _TURNS * len(_TYPES))
    if version + 1 != VERSION:
        raise CodecError(f"its version must be {VERSION}; got {version + 1}")
    height, width = reader.varint("height", 1, MOST_SIDE), reader.varint("width", 1, MOST_SIDE)
    if height * width > MOST_LABELS:
        raise CodecError(f"a map must have at most {MOST_LABELS} pixels; got {height} x {width}")
    from .labels.coding import decode_turned  # loads numba

    labels = decode_turned(reader.data[reader.position :], (height, width), form % _TURNS)
    dtype = _TYPES[form // _TURNS]
    most = 1 if dtype == torch.bool else torch.iinfo(dtype).max
    if (highest := int(labels.max())) > most:
        raise CodecError(f"ids of {dtype} must be at most {most}; got {highest}")
    return torch.from_numpy(labels).to(dtype)
