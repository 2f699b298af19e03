"""The stream of a label map without loss, a few hundred bytes for a photo's regions (docs/format.md, "Labels")."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kcgs.codec.exact import Integers
from kcgs.codec.rangecoder import Reader, Writer

from .ids import code_ids
from .pixels import WorkLimitError, code_pixels
from .wavefront import number_regions

_NOISE_CHANCE = np.array([2.0**-10])  # that a map is coded as noise
_NOISE_OVERHEAD = 64  # bits by which the model may exceed noise


def encode_stream(ids: Integers, index: Any, *, is_file: bool) -> bytes:
    """Write a map, (H, W) int32 positions among its sorted ids, without its height and width.

    `is_file` says whether the map is a file of its own, or that of a scene, which has other models.
    """
    truth, seeds, order = number_regions(index, len(ids))
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
        pass  # noise, or nearly
    writer = _start(numbered, is_file, is_noise=True)
    writer.numbers(truth.reshape(-1), len(ids), index.size)
    return writer.finish()


def _start(numbered: list[int], is_file: bool, *, is_noise: bool) -> Writer:
    """Return a writer of what precedes the pixels."""
    writer = Writer()
    code_ids(writer, numbered, len(numbered), is_file=is_file)
    if len(numbered) > 1:
        writer.bits(_NOISE_CHANCE, np.array([is_noise], np.int32))
    return writer


def decode_stream(data: bytes, size: tuple[int, int], max_regions: int, *, is_file: bool) -> tuple[Integers, Any]:
    """Read a map; return its ids, in the order in which regions are numbered, and the number of each pixel's region."""
    reader, (height, width) = Reader(data), size
    ids = np.array(code_ids(reader, [], min(max_regions, height * width), is_file=is_file), np.int64)
    if len(ids) == 1:
        return ids, np.broadcast_to(np.int32(0), size)
    if reader.bits(_NOISE_CHANCE, np.zeros(1, np.int32))[0]:
        return ids, reader.numbers(None, len(ids), height * width).reshape(size)
    truth, seeds = np.zeros((0, 0), np.int32), np.zeros(size, np.uint8)
    return ids, code_pixels(reader, truth, seeds, len(ids), is_file=is_file)
