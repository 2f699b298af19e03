"""A region map in a file: its labels at their own resolution, and how wide the contours are (docs/format.md)."""

from __future__ import annotations

import math

import numpy as np
import torch

from kcgs._check import check_count
from kcgs.codec.adaptive import AdaptiveSymbol
from kcgs.codec.exact import Integers
from kcgs.codec.file import MOST_LABELS, MOST_REGIONS, ByteReader, varint
from kcgs.codec.rangecoder import CodecError, Coder, Reader, Writer
from kcgs.functional import MAX_SOFTNESS, PairWidths, RegionMap
from kcgs.functional.labels import touching_pairs

from .coding import decode_labels, encode_labels

_FORTIETHS = 40  # of a pixel
_MOST_WIDTH = int(MAX_SOFTNESS) * _FORTIETHS
_MOST_SUPERSAMPLE = 64
_TOGETHER = 32  # pairs that are coded before their model learns


def encode_map(regions: RegionMap) -> bytes:
    """Write a map with two regions or more; contour widths are rounded to fortieths of a pixel."""
    if regions.labels.ndim != 2 or regions.resized:
        raise ValueError("regions must be one map of its own pixels, not a batch and not resized")
    check_count("supersample", regions.supersample, 1, _MOST_SUPERSAMPLE)
    check_count("number of labels", regions.fine_labels.numel(), 1, MOST_LABELS)
    check_count("number of regions", regions.num_regions, 1, MOST_REGIONS)
    labels = encode_labels(regions.fine_labels.cpu().numpy())
    softness = regions.softness
    if isinstance(softness, PairWidths):
        widths = [_round(softness.get(pair, 0.0)) for pair in sorted(touching_pairs(regions.fine_labels))]
    else:
        widths = [_round(softness)]
    distinct = sorted(set(widths))
    head = varint(regions.supersample) + varint(len(labels)) + labels
    head += b"".join(map(varint, [len(distinct), *distinct]))
    if len(distinct) == 1:
        return head
    writer = Writer()
    _code_places(writer, len(widths), len(distinct), np.array([distinct.index(width) for width in widths]))
    return head + writer.finish()


def decode_map(data: bytes, size: tuple[int, int], num_regions: int) -> RegionMap:
    """Read a map of `num_regions` regions for an image of `size`."""
    stream = ByteReader(data)
    k = stream.varint("labels along a side of a pixel", 1, _MOST_SUPERSAMPLE)
    if size[0] * size[1] * k * k > MOST_LABELS:
        raise CodecError(f"a map must have at most {MOST_LABELS} labels; got {size} times {k} squared")
    coded = stream.take(stream.varint("length of the labels", 1, len(data)))
    labels = torch.from_numpy(decode_labels(coded, k * size[0], k * size[1], max_regions=num_regions))
    count = stream.varint("contour widths", 1, min(_MOST_WIDTH + 1, len(data)))
    distinct = [stream.varint("a contour width", 0, _MOST_WIDTH) / _FORTIETHS for _ in range(count)]
    softness: float | dict[tuple[int, int], float] = distinct[0]
    if count > 1:
        pairs, rest = sorted(touching_pairs(labels)), stream.take(len(data) - stream.position)
        places = _code_places(Reader(rest), len(pairs), count, None).tolist()
        softness = {pair: distinct[place] for pair, place in zip(pairs, places, strict=True)}
    elif stream.position != len(data):
        raise CodecError(f"the map must end after {stream.position} bytes; got {len(data)}")
    regions = RegionMap.from_labels(labels, softness, supersample=k)
    if regions.num_regions != num_regions:
        raise CodecError(f"the map must have {num_regions} regions; got {regions.num_regions}")
    return regions


def _round(width: float) -> int:
    return math.floor(width * _FORTIETHS + 0.5)


def _code_places(coder: Coder, pairs: int, count: int, places: Integers | None) -> Integers:
    """Code the width of each pair, as its place in the list of different widths."""
    model, found = AdaptiveSymbol(np.ones(count)), np.zeros(pairs, np.int64)
    for start in range(0, pairs, _TOGETHER):
        part = slice(start, start + _TOGETHER)
        found[part] = model.code(coder, len(found[part]), None if places is None else places[part])
    return found
