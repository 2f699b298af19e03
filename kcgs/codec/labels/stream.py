"""The lossless stream of a label map, a few hundred bytes for a photo's regions (docs/format.md, "Labels")."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcgs._rows import row_slices
from kcgs.codec.exact import Integers
from kcgs.codec.rangecoder import Reader, Writer

from .ids import code_ids
from .pixels import WorkLimitError, code_pixels
from .wavefront import order_regions

_NOISE_CHANCE = np.array([2.0**-10])  # chance that a map is coded as noise
_NOISE_OVERHEAD = 64  # bits by which the model's stream may exceed that of noise
# a decoder refuses a map with more regions than both limits: an encoder writes no such map
_FREE_REGIONS = (1 << 18) + 1
_REGIONS_PER_BYTE = 4


def encode_stream(ids: Integers, index: Any, *, is_file: bool) -> bytes:
    """Write a map, (H, W) int32 indices into its sorted ids, without its height and width.

    `is_file`: the file of a label map; False: the map of a scene, which has other models.
    """
    truth, seeds, order = order_regions(index, len(ids))
    numbered = ids[order].tolist()
    writer = _start(numbered, is_file, is_noise=False)
    if len(ids) == 1:
        return writer.finish()
    try:
        code_pixels(writer, truth, seeds, len(ids), is_file=is_file)
        data = writer.finish()
        if 8 * len(data) <= index.size * math.log2(len(ids)) + _NOISE_OVERHEAD:
            return data
    except WorkLimitError:
        pass  # the map is close to noise
    writer = _start(numbered, is_file, is_noise=True)
    writer.numbers(truth.reshape(-1), len(ids), index.size)
    return writer.finish()


def _start(numbered: list[int], is_file: bool, *, is_noise: bool) -> Writer:
    """Return a writer that has written all that precedes the pixels."""
    writer = Writer()
    code_ids(writer, numbered, len(numbered), is_file=is_file)
    if len(numbered) > 1:
        writer.bits(_NOISE_CHANCE, np.array([is_noise], np.int32))
    return writer


def decode_ids(data: bytes, size: tuple[int, int], max_regions: int, *, is_file: bool) -> tuple[Reader, Integers]:
    """Read the ids of a map, in the order of the regions' numbers; return them and the reader of its pixels."""
    reader, max_of_bytes = Reader(data), max(_FREE_REGIONS, _REGIONS_PER_BYTE * len(data))
    ids = code_ids(reader, [], min(max_regions, max_of_bytes, size[0] * size[1]), is_file=is_file)
    return reader, np.array(ids, np.int64)


def decode_numbers(reader: Reader, size: tuple[int, int], num_regions: int, *, is_file: bool) -> Any:
    """Read the number of each pixel's region, (H, W) int32."""
    if num_regions == 1:
        return np.broadcast_to(np.int32(0), size)
    if reader.bits(_NOISE_CHANCE, np.zeros(1, np.int32))[0]:
        return reader.numbers(None, num_regions, size[0] * size[1]).reshape(size)
    return code_pixels(reader, np.zeros((0, 0), np.int32), np.zeros(size, np.uint8), num_regions, is_file=is_file)


def label_pixels(ids: NDArray[Any], numbers: Any) -> NDArray[Any]:
    """Return the id of each pixel, (H, W) in the dtype of `ids`; `numbers` are those of regions, of any strides."""
    labels = np.empty(numbers.shape, ids.dtype)
    for rows in row_slices(*numbers.shape):
        labels[rows] = ids[numbers[rows]]
    return labels
