"""The region map of a scene's file: its labels and the softness of its contours (docs/format.md, "The region map")."""

from __future__ import annotations

import math

import numpy as np
import torch

from kcgs._check import check_count
from kcgs.errors import InvalidArgument
from kcgs.maps import MAX_SOFTNESS, RegionMap, compact, softness_between, softness_of_map, touching_pairs, wrap_labels

from .adaptive import AdaptiveSymbol
from .exact import Integers
from .file import MAX_LABELS, MAX_REGIONS, ByteReader, varint
from .rangecoder import CodecError, Coder, Reader, Writer

_UNITS = 40  # units of softness per pixel
_MAX_UNITS = int(MAX_SOFTNESS) * _UNITS
_GROUP = 32  # pairs between two updates of the model


def encode_region_map(regions: RegionMap) -> bytes:
    """Write a map of two or more regions; softness is rounded to fortieths of a pixel."""
    from .labels.stream import encode_stream  # loads numba

    if regions.is_resampled:
        raise InvalidArgument("regions", "a map of its own pixels", "one that was resized")
    check_count("number of labels", regions.labels.numel(), 1, MAX_LABELS)
    check_count("number of regions", regions.num_regions, 1, MAX_REGIONS)
    ids, index = compact(regions.labels.cpu())
    labels = encode_stream(ids.numpy(), index.numpy(), is_file=False)
    softness = softness_of_map(regions.softness)
    units = [_round(softness_between(softness, a, b)) for a, b in sorted(touching_pairs(regions.labels))]
    palette = sorted(set(units))
    head = varint(len(labels)) + labels + b"".join(map(varint, [len(palette), *palette]))
    if len(palette) == 1:
        return head
    writer = Writer()
    _code_palette(writer, len(palette), np.array([palette.index(unit) for unit in units]))
    return head + writer.finish()


def _round(softness: float) -> int:
    return math.floor(softness * _UNITS + 0.5)


def decode_region_map(data: bytes, size: tuple[int, int], num_regions: int) -> RegionMap:
    """Read a map of `num_regions` regions for an image of `size`."""
    from .labels.stream import decode_ids, decode_numbers, label_pixels  # loads numba

    reader = ByteReader(data)
    stream = reader.take(reader.varint("length of the labels", 1, len(data)))
    pixels, ids = decode_ids(stream, size, num_regions, is_file=False)
    if len(ids) != num_regions:
        raise CodecError(f"the map must have {num_regions} regions; got {len(ids)}")
    with torch.inference_mode(False):  # as RegionMap does
        labels = torch.from_numpy(label_pixels(ids, decode_numbers(pixels, size, num_regions, is_file=False)))
    count = reader.varint("numbers of softness", 1, min(_MAX_UNITS + 1, len(data)))
    palette = [reader.varint("softness", 0, _MAX_UNITS) / _UNITS for _ in range(count)]
    softness: float | dict[tuple[int, int], float] = palette[0]
    if count > 1:
        pairs = sorted(touching_pairs(labels))
        stream = reader.take(len(data) - reader.position)
        indices = _code_palette(Reader(stream), count, np.zeros(len(pairs), np.int64)).tolist()
        softness = {pair: palette[index] for pair, index in zip(pairs, indices, strict=True)}
    elif reader.position != len(data):
        raise CodecError(f"the map must end after {reader.position} bytes; got {len(data)}")
    regions = wrap_labels(labels, softness)
    if regions.num_regions != num_regions:
        raise CodecError(f"the map must have {num_regions} regions; got {regions.num_regions}")
    return regions


def _code_palette(coder: Coder, size: int, indices: Integers) -> Integers:
    """Code the softness of each pair, as its index in the palette."""
    model, coded = AdaptiveSymbol(np.ones(size)), np.zeros_like(indices)
    for start in range(0, len(indices), _GROUP):
        group = slice(start, start + _GROUP)
        coded[group] = model.code(coder, indices[group])
    return coded
