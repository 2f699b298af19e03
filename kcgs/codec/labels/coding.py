"""Label maps without loss, a few hundred bytes for a photo's regions, and how wide contours are (docs/format.md)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from kcgs._check import check_count
from kcgs.codec.adaptive import AdaptiveBit, AdaptiveSymbol
from kcgs.codec.exact import Integers
from kcgs.codec.file import MOST_LABELS, MOST_REGIONS, ByteReader, varint
from kcgs.codec.rangecoder import CodecError, Coder, Reader, Writer
from kcgs.functional import PairSoftness, RegionMap
from kcgs.functional.labels import compact, touching_pairs
from kcgs.functional.softness import MAX_SOFTNESS

from .contexts import CODED, LABEL, LEFT, RIGHT, TOP, load_prior, new_tables
from .ids import code_ids, code_ids_of_file
from .seeds import code_seeds
from .wavefront import DECIDED, RANKS, REGIONS, STATE, WIDE, advance, nearest, new_work, survey

# what a reader may be asked to work through: seconds
_MOST_ASKED, MOST_ESCAPES = 1 << 23, 1 << 18
_NOISY = np.array([2.0**-10])  # chance of a map that the model makes larger
_FORTIETHS = 40  # of a pixel
_MOST_WIDTH = int(MAX_SOFTNESS) * _FORTIETHS
_TOGETHER = 32  # pairs that are coded before their model learns
# ways to turn a map and to mirror it; how many are tried, and with how many seeds more than the fewest
TURNS, _TRIED, _NEAR = 8, 2, 3


def encode_labels(labels: Integers) -> bytes:
    """Write a label map (H, W), ids of 0 to 2**63 - 1, without its height and width; the bytes are the same everywhere.

    Example:
        >>> halves = np.repeat([[5], [9]], 32, axis=0) + np.zeros((1, 64), np.int64)
        >>> len(encode_labels(halves)) < 12
        True
    """
    ids, index = (found.numpy() for found in compact(torch.from_numpy(labels))[:2])
    return encode_regions(ids, index)


def encode_turned(labels: Integers) -> tuple[int, bytes]:
    """Write a map in the form of files, turned as it takes the fewest bytes among the ways with the fewest seeds."""
    ids, index = (found.numpy() for found in compact(torch.from_numpy(labels))[:2])
    check_count("number of regions", len(ids), 1, MOST_REGIONS)
    seeds = [int(survey(turned(index, turn), len(ids))[1].sum()) for turn in range(TURNS)]
    tried = [t for t in sorted(range(TURNS), key=seeds.__getitem__)[:_TRIED] if seeds[t] <= min(seeds) + _NEAR]
    found = [(turn, encode_regions(ids, turned(index, turn), alone=True)) for turn in tried]
    return min(found, key=lambda coded: len(coded[1]))


def decode_turned(data: bytes, size: tuple[int, int], turn: int, dtype: str) -> tuple[Any, Integers]:
    """Read a map that `encode_turned` wrote, in the type of its ids, and the ids."""
    # more are noise, of more bytes; as many a reader may be asked to list
    most = min(MOST_REGIONS, max(MOST_ESCAPES + 1, 4 * len(data)))
    ids, index = _decode_regions(data, *(size[::-1] if turn & 4 else size), most, alone=True)
    highest = 1 if dtype == "bool" else np.iinfo(dtype).max
    if ids.max() > highest:
        raise CodecError(f"ids of {dtype} must be at most {highest}; got {ids.max()}")
    return turned(ids.astype(dtype)[index], turn, back=True), ids


def turned(labels: Any, turn: int, *, back: bool = False) -> Any:
    """Transpose a map if `turn` has 4, reverse its rows if 2, then its columns if 1; or take that back."""
    labels = labels.T if turn & 4 and not back else labels
    labels = labels[:: -1 if turn & 2 else 1, :: -1 if turn & 1 else 1]
    return np.ascontiguousarray(labels.T if turn & 4 and back else labels)


def encode_regions(ids: Integers, index: Any, *, alone: bool = False) -> bytes:
    """Write a map of positions among ids; `alone`: in the form of files."""
    code = code_ids_of_file if alone else code_ids
    if len(ids) == 1:
        writer = Writer()
        code(writer, ids.tolist(), 1)
        return writer.finish()
    truth, seeds, order = survey(index, len(ids))
    numbered = ids[order].tolist()

    def begin(noisy: int) -> Writer:
        writer = Writer()
        code(writer, numbered, len(ids))
        writer.bits(_NOISY, np.array([noisy], np.int32))
        return writer

    try:
        writer = begin(0)
        _code_pixels(writer, truth, seeds, len(ids), alone)
        data = writer.finish()
        if 8 * len(data) <= index.size * math.log2(len(ids)) + 64:
            return data
    except _Laborious:
        pass  # noise, or nearly
    writer = begin(1)
    writer.numbers(truth.reshape(-1), len(ids), index.size)
    return writer.finish()


def decode_labels(data: bytes, height: int, width: int, *, max_regions: int) -> Integers:
    """Read a label map (H, W); what is none, or has more regions, is a CodecError.

    Example:
        >>> labels = np.array([[7, 7, 3], [7, 3, 3]])
        >>> (decode_labels(encode_labels(labels), 2, 3, max_regions=2) == labels).all()
        np.True_
    """
    ids, index = _decode_regions(data, height, width, max_regions, alone=False)
    labels: Integers = ids[index]
    return labels


def _decode_regions(data: bytes, height: int, width: int, max_regions: int, *, alone: bool) -> tuple[Integers, Any]:
    """Return a map's ids, and of each pixel the position of its own."""
    reader, code = Reader(data), code_ids_of_file if alone else code_ids
    ids = np.array(code(reader, [], min(max_regions, height * width)), np.int64)
    if len(ids) == 1:
        return ids, np.broadcast_to(np.int32(0), (height, width))
    if reader.bits(_NOISY, np.zeros(1, np.int32))[0]:
        return ids, reader.numbers(None, len(ids), height * width).reshape(height, width)
    empty, seeds = np.zeros((0, 0), np.int32), np.zeros((height, width), np.uint8)
    return ids, _code_pixels(reader, empty, seeds, len(ids), alone)


def _code_pixels(coder: Coder, truth: Any, seeds: Any, regions: int, alone: bool) -> Any:
    """Code a map of numbered regions; a reader has an empty `truth` and fills in `seeds`."""
    code_seeds(coder, seeds)
    height, width = seeds.shape
    tables = load_prior("prior2.bin" if alone else "prior.bin")
    rows, chances, lines = new_work(height, tables)
    labels = np.zeros((height + TOP + 1, width + LEFT + RIGHT), np.int32)
    state = np.zeros(STATE, np.int64)
    state[REGIONS], state[WIDE] = regions, alone
    escapes = _Escapes(coder, labels, regions)
    answers = np.zeros(2 * height, np.int32)
    memory = (truth, answers, state, labels, seeds, *new_tables(tables), rows, chances, lines)
    bits, asked = answers[:0], 0
    while count := advance(bits, *memory):
        decided = int(state[DECIDED])
        used = decided if regions == 2 else 2 * decided
        asked += decided
        if asked > _MOST_ASKED:
            raise _Laborious(f"data must ask for at most {_MOST_ASKED} pixels near contours; got more")
        if used:
            bits = coder.bits(chances[:used], answers[:used])
        if regions > 2 and (count > decided or np.count_nonzero(bits[:decided])):
            escapes.code(rows[:count], bits[:decided] != 0)
    return labels[TOP : TOP + height, LEFT : LEFT + width]


class _Laborious(CodecError):
    """A map that would take minutes to read."""


class _Escapes:
    """Labels of pixels that are neither candidate."""

    def __init__(self, coder: Coder, labels: Any, regions: int) -> None:
        self._coder, self._labels, self._regions = coder, labels, regions
        self._met, self._count = 1, 0
        # of seeds, and of others
        self._new = [AdaptiveBit(), AdaptiveBit()]
        self._rank = [[AdaptiveBit() for _ in range(RANKS)] for _ in range(2)]
        self._found = np.zeros(RANKS, np.int32)

    def code(self, rows: Any, neither: Any) -> None:
        """Code the labels of a wavefront."""
        asked = rows[:, CODED] == 0
        asked[~asked] = neither
        self._count += int(asked.sum())
        if self._count > MOST_ESCAPES:
            raise _Laborious(f"data must hold at most {MOST_ESCAPES} labels that no neighbour has; got more")
        for place in np.flatnonzero(asked):
            rows[place, LABEL] = self._code(rows[place])

    def _code(self, row: Any) -> int:
        label, coded = int(row[LABEL]), int(row[CODED])
        if self._met < self._regions and self._new[coded].code(self._coder, label == self._met):
            self._met += 1
            return self._met - 1
        for rank in range(nearest(self._labels, row, self._found)):
            guess = int(self._found[rank])
            if self._rank[coded][rank].code(self._coder, label == guess):
                return guess
        if (found := self._coder.number(label, self._met)) >= self._met:
            raise CodecError(f"data must hold labels of {self._met} regions that were met; got {found}")
        return found


def encode_map(regions: RegionMap) -> bytes:
    """Write a map with two regions or more; contour widths are rounded to fortieths of a pixel."""
    if regions.num_maps is not None or regions.resized:
        raise ValueError("regions must be one map of its own pixels, not a batch and not resized")
    check_count("number of labels", regions.labels.numel(), 1, MOST_LABELS)
    check_count("number of regions", regions.num_regions, 1, MOST_REGIONS)
    labels = encode_labels(regions.labels.cpu().numpy())
    softness = regions.softness
    if isinstance(softness, PairSoftness):
        widths = [_round(softness.get(pair, 0.0)) for pair in sorted(touching_pairs(regions.labels))]
    else:
        widths = [_round(softness)]
    distinct = sorted(set(widths))
    head = varint(len(labels)) + labels + b"".join(map(varint, [len(distinct), *distinct]))
    if len(distinct) == 1:
        return head
    writer = Writer()
    _code_places(writer, len(widths), len(distinct), np.array([distinct.index(width) for width in widths]))
    return head + writer.finish()


def decode_map(data: bytes, size: tuple[int, int], num_regions: int) -> RegionMap:
    """Read a map of `num_regions` regions for an image of `size`."""
    stream = ByteReader(data)
    coded = stream.take(stream.varint("length of the labels", 1, len(data)))
    labels = torch.from_numpy(decode_labels(coded, size[0], size[1], max_regions=num_regions))
    count = stream.varint("contour widths", 1, min(_MOST_WIDTH + 1, len(data)))
    distinct = [stream.varint("a contour width", 0, _MOST_WIDTH) / _FORTIETHS for _ in range(count)]
    softness: float | dict[tuple[int, int], float] = distinct[0]
    if count > 1:
        pairs, rest = sorted(touching_pairs(labels)), stream.take(len(data) - stream.position)
        places = _code_places(Reader(rest), len(pairs), count, None).tolist()
        softness = {pair: distinct[place] for pair, place in zip(pairs, places, strict=True)}
    elif stream.position != len(data):
        raise CodecError(f"the map must end after {stream.position} bytes; got {len(data)}")
    regions = RegionMap.from_labels(labels, softness)
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
