"""A region map in a file: labels, and how wide the contours are.

======================  ==================================================================================
bytes                   meaning
======================  ==================================================================================
varint                  labels along a side of a pixel, k, at most 64
varint, labels          length in bytes; the map of (k height, k width) as `labels` says
varint                  W, how many different widths there are
varint                  for each: the width in fortieths of a pixel
widths                  if W > 1, to the end, bytes as `labels` says: for each two regions with labels side by side
                        or one above the other, a < b by positions among the sorted ids, in order: its place in
                        that list, by Choices (`models`) whose weights start at 1, in groups of 32 pairs
======================  ==================================================================================
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs.functional import RegionMap
from kcgs.functional.regions import MAX_SOFTNESS, PairWidths

from .errors import CodecError
from .models import Choices
from .rangecoder import Coder, Reader, Writer
from .stream import MOST_LABELS, ByteReader, varint

Integers = NDArray[np.int64]
_FORTIETHS = 40
_MOST_WIDTH = int(MAX_SOFTNESS) * _FORTIETHS
MOST_SUPERSAMPLE = 64
_AT_ONCE = 32


def encode_map(regions: RegionMap) -> bytes:
    """Write a map with two regions or more; contour widths are rounded to fortieths of a pixel."""
    from .labels import compact, encode_labels  # compiles loops

    if regions.labels.ndim != 2 or regions.resized:
        raise ValueError("regions must be one map of its own pixels, not a batch and not resized")
    fine = regions.fine_labels
    labels = encode_labels(fine.cpu().numpy())
    pairs = _touching(compact(fine.cpu().numpy())[1], regions.num_regions)
    softness, ids = regions.softness, regions.ids.tolist()
    if isinstance(softness, PairWidths):
        widths = [_round(softness.get((ids[a], ids[b]), 0.0)) for a, b in pairs.tolist()]
    else:
        widths = [_round(softness)]
    distinct = sorted(set(widths))
    head = varint(regions.supersample) + varint(len(labels)) + labels
    head += b"".join(map(varint, [len(distinct), *distinct]))
    if len(distinct) == 1:
        return head
    writer = Writer()
    _code_places(writer, len(pairs), len(distinct), np.array([distinct.index(width) for width in widths]))
    return head + writer.finish()


def decode_map(data: bytes, size: tuple[int, int], num_regions: int) -> RegionMap:
    """Read a map of `num_regions` regions for a picture of `size`."""
    from .labels import decode_labels

    stream = ByteReader(data)
    k = stream.varint("labels along a side of a pixel", 1, MOST_SUPERSAMPLE)
    if size[0] * size[1] * k * k > MOST_LABELS:
        raise CodecError(f"a map must have at most {MOST_LABELS} labels; got {size} times {k} squared")
    labels = stream.take(stream.varint("length of the labels", 1, len(data)))
    found = decode_labels(labels, k * size[0], k * size[1], max_regions=num_regions)
    count = stream.varint("contour widths", 1, min(_MOST_WIDTH + 1, len(data)))
    distinct = [stream.varint("a contour width", 0, _MOST_WIDTH) / _FORTIETHS for _ in range(count)]
    if count == 1 and stream.at != len(data):
        raise CodecError(f"the map must end after {stream.at} bytes; got {len(data)}")
    widths = distinct[0] if count == 1 else _read_widths(stream.take(len(data) - stream.at), found, distinct)
    regions = RegionMap.from_labels(torch.from_numpy(found), widths, supersample=k)
    if regions.num_regions != num_regions:
        raise CodecError(f"the map must have {num_regions} regions; got {regions.num_regions}")
    return regions


def _read_widths(data: bytes, labels: Integers, distinct: list[float]) -> dict[tuple[int, int], float]:
    from .labels import compact

    ids, index = compact(labels)
    pairs = _touching(index, len(ids))
    places = _code_places(Reader(data), len(pairs), len(distinct), None)
    named = zip(ids[pairs].tolist(), places.tolist(), strict=True)
    return {(a, b): distinct[place] for (a, b), place in named}


def _round(width: float) -> int:
    return math.floor(width * _FORTIETHS + 0.5)


def _code_places(coder: Coder, pairs: int, count: int, places: Integers | None) -> Integers:
    model, found = Choices(np.ones(count)), np.zeros(pairs, np.int64)
    for start in range(0, pairs, _AT_ONCE):
        part = slice(start, min(start + _AT_ONCE, pairs))
        context = np.zeros(part.stop - start, np.int64)
        found[part] = model.code(coder, context, None if places is None else places[part])
    return found


def _touching(index: Integers, num_regions: int) -> Integers:
    """Return the pairs of positions a < b [P, 2] of regions that have labels side by side."""
    keys = []
    for here, there in ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:])):
        differ = here != there
        low, high = np.minimum(here[differ], there[differ]), np.maximum(here[differ], there[differ])
        keys.append(np.unique(low.astype(np.int64) * num_regions + high))
    key = np.unique(np.concatenate(keys))
    return np.stack([key // num_regions, key % num_regions], -1)
