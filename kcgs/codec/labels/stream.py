"""The stream of a label map without loss, a few hundred bytes for a photo's regions (docs/format.md, "Labels")."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from kcgs.codec.exact import Integers
from kcgs.codec.rangecoder import Coder, Reader, Writer

from .ids import code_ids_of_file, code_ids_of_scene
from .pixels import WorkLimitError, code_pixels
from .wavefront import survey

_NOISE_CHANCE = np.array([2.0**-10])  # that a map is coded as noise
_NOISE_OVERHEAD = 64  # bits by which the model may exceed noise


class Profile(NamedTuple):
    """In what the streams of scenes and of files of maps differ."""

    code_ids: Callable[[Coder, list[int], int], list[int]]
    is_file: bool  # which tables the model has


SCENE_PROFILE = Profile(code_ids_of_scene, False)
FILE_PROFILE = Profile(code_ids_of_file, True)


def encode_stream(ids: Integers, index: Any, profile: Profile) -> bytes:
    """Write a map, (H, W) int32 positions among its sorted ids, without its height and width."""
    if len(ids) == 1:
        writer = Writer()
        profile.code_ids(writer, ids.tolist(), 1)
        return writer.finish()
    truth, seeds, order = survey(index, len(ids))
    numbered = ids[order].tolist()
    writer = _start(numbered, profile, is_noise=False)
    try:
        code_pixels(writer, truth, seeds, len(ids), is_file=profile.is_file)
        data = writer.finish()
        if 8 * len(data) <= index.size * math.log2(len(ids)) + _NOISE_OVERHEAD:
            return data
    except WorkLimitError:
        pass  # noise, or nearly
    writer = _start(numbered, profile, is_noise=True)
    writer.numbers(truth.reshape(-1), len(ids), index.size)
    return writer.finish()


def _start(numbered: list[int], profile: Profile, *, is_noise: bool) -> Writer:
    """Return a writer of what precedes the pixels."""
    writer = Writer()
    profile.code_ids(writer, numbered, len(numbered))
    writer.bits(_NOISE_CHANCE, np.array([is_noise], np.int32))
    return writer


def decode_stream(data: bytes, size: tuple[int, int], max_regions: int, profile: Profile) -> tuple[Integers, Any]:
    """Read a map; return its ids, in the order in which regions are numbered, and the number of each pixel's region."""
    reader, (height, width) = Reader(data), size
    ids = np.array(profile.code_ids(reader, [], min(max_regions, height * width)), np.int64)
    if len(ids) == 1:
        return ids, np.broadcast_to(np.int32(0), size)
    if reader.bits(_NOISE_CHANCE, np.zeros(1, np.int32))[0]:
        return ids, reader.numbers(None, len(ids), height * width).reshape(size)
    truth, seeds = np.zeros((0, 0), np.int32), np.zeros(size, np.uint8)
    return ids, code_pixels(reader, truth, seeds, len(ids), is_file=profile.is_file)


def count_seeds(index: Any, num_regions: int) -> int:
    """Count the seeds of a map: the fewer, the smaller its stream, as a rule."""
    return int(survey(index, num_regions)[1].sum())
