"""Label maps without loss: a few hundred bytes for a photo's regions.

The stream, for a map of H x W pixels whose size the reader knows
----------------------------------------------------------------

**Bytes.** They are what constriction's range coder (``stream.queue.RangeEncoder``: 32-bit words, 64-bit state) makes of
the symbols below, each word's highest byte first. Bytes of zero at the end are left out, and the last bytes are those
that leave out most; a reader puts zeros behind the stream. It has three numbers of 64 bits: ``low`` is 0, ``range`` is
2**64 - 1, ``point`` the first two words. The code of a symbol is ``(point - low) // step`` with ``step = range >> 24``;
those from a to b - 1 mean it; then ``low += a * step``, ``range = (b - a) * step``, modulo 2**64; and if ``range`` is
below 2**32, all three move up by 32 bits, and ``point`` takes the next word in. Probabilities have 24 bits in
constriction. A *bit of chance p* is its Bernoulli model with p in whole 1/65536, exact there: the last 256 p of the
2**24 codes mean 1. A *number of n* is its Uniform model (`models` says its codes), n at most 65536; for n = 1 nothing
is coded. A larger n is coded as a number of ceil(n / 65536) (the value's part above 16 bits, itself so if it must be),
then one of 65536. A *fair bit* is a number of 2. *k plain bits* are numbers of 65536, lowest bits first, the last one
of the 2**(k mod 16) that are left. A *magnitude* is the value's count of bits, a number of 64, then the plain bits
below its highest one. A *learnt bit* has the chance ``ones / all``, rounded down to 1/65536 and kept within 64 of 0 and
of 65536; ``all`` starts at 4 and ``ones`` at 2; each bit adds 2 to ``all``, and 2 to ``ones`` if it is 1.

**Regions.** Their number R: fair bits of 1 for floor(log2 R), a fair bit of 0, and so many plain bits of R. Then a fair
bit: 0 if the ids of regions, in the order in which regions are numbered (below), are 0 to R - 1. Else the ids: sorted,
each as the magnitude of its distance from the one before, less 1 (the first: from -1); then for each region, in
order, which of the sorted ids that are left it has, a number of as many. With R = 1 the stream ends here.

**Noise.** A bit of chance 64 / 65536. If it is 1, the regions' numbers follow row by row, numbers of R each (here R may
exceed 65536, up to 2**24), and that is all. Encoders choose this for maps that would take more bytes otherwise.

**Order.** Pixels go in *waves*: x + 8 y is the same in a wave, waves go by that sum, a wave goes by y. Regions are
numbered from 0 as they are met. Chances of a wave's bits depend on the waves before it only. Pixels outside the map
have labels too: to the left of row y, that of pixel (0, y - 1), and 0 for y = 0; to the right of row y, that of its
last pixel; above row 0, that of the pixel of row 0 in the same column if its wave is earlier; up to 9 columns beyond
the last such pixel, the label of that one; farther to the right, 0.

**Starts.** A pixel is *quiet* if its neighbours (-2, 0), (-1, 0), (-2..7, -1) and (-1..3, -2) have one label. A quiet
pixel with another label than these is a start. The number of starts is a magnitude. Then blocks are halved, the map
first: across the longer side (across its height if they are equal), the first half being the smaller one, the second
half's part before the first half's. A block of one start holds its place, row by row, as a number of its size; a block
without or full of starts holds nothing. For others the number in the first half is between ``low`` and ``high``, what
the sizes allow, and nothing is coded if they are equal. Else, if they differ by more than 1, a learnt bit says whether
it is one of the two (a bit for each floor(log2 count) - 1, from 7 on shared); if so, or if they differ by 1, a fair bit
says which: 1 for ``high``; else it is ``low`` + 1 plus a number of ``high - low - 1``.

**Pixels.** A quiet pixel that is no start has its neighbours' label. With R = 2 a start has the other one. All others
are coded wave by wave. A pixel that is not quiet has two candidates: the label of (-1, 0), and the first other one in
the template (`prior.TEMPLATE`). With R > 2 comes first, for each such pixel of the wave, a bit whether it is neither.
Then for each a bit that is 1 if it is the second (of those that are neither: 1, and not learnt from). The chances are
the model's, in `contexts`; all its arithmetic is in integers, ``>>`` and ``//`` round down. With R > 2 the labels of
starts and of pixels that are neither follow, in the order of the wave:

- if not all R regions have been met, a learnt bit: 1 for the next new one (one bit for starts, one for others);
- else for each of up to three labels in turn a learnt bit whether it is this one (three bits for starts, three for
  others); these are the nearest labels that are no candidates, see `waves`;
- if it is none of them, the label, a number of as many as were met.

A stream that codes more than 2**23 pixels, or more than 2**18 labels of starts and of pixels that are neither, is
refused, since it would take minutes to read; maps like that are written plainly.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from .contexts import CODED, LABEL, LEFT, RIGHT, TOP, new_tables
from .errors import CodecError
from .rangecoder import Coder, Counter, Reader, Writer, fair, magnitude, plain, uniform
from .starts import code_starts
from .waves import DECIDED, RANKS, REGIONS, STATE, Loops, loops, new_work

# what a reader may be asked to work through: seconds
_MOST_ASKED, _MOST_ESCAPES = 1 << 23, 1 << 18
Labels = NDArray[np.int64]
_TABLE = 1 << 20  # ids below it are looked up, not sorted
_MOST = 24  # bits of the number of regions
_NOISY = np.array([2.0**-10])  # chance of a map that the model makes larger


def encode_labels(labels: Labels) -> bytes:
    """Write a label map.

    Args:
        labels: (H, W), ids of 0 to 2**63 - 1.

    Returns:
        The map without its height and width; the same map gives the same bytes everywhere.

    Example:
        >>> halves = np.repeat([[5], [9]], 32, axis=0) + np.zeros((1, 64), np.int64)
        >>> len(encode_labels(halves)) < 12
        True
    """
    ids, index = compact(labels)
    writer = Writer()
    if len(ids) == 1:
        _code_ids(writer, ids.tolist(), 1)
        return writer.finish()
    truth, starts, order = loops().survey(index, len(ids))
    numbered = ids[order].tolist()
    _code_ids(writer, numbered, len(ids))
    writer.bits(_NOISY, np.zeros(1, np.int32))
    try:
        _code_pixels(writer, truth, starts, len(ids))
        data = writer.finish()
        if 8 * len(data) <= labels.size * math.log2(len(ids)) + 64:
            return data
    except _Laborious:
        pass  # noise, or nearly
    writer = Writer()
    _code_ids(writer, numbered, len(ids))
    writer.bits(_NOISY, np.ones(1, np.int32))
    writer.numbers(truth.reshape(-1), len(ids), labels.size)
    return writer.finish()


def decode_labels(data: bytes, height: int, width: int, *, max_regions: int) -> Labels:
    """Read a label map.

    Args:
        data: what `encode_labels` returned.
        height: of the map.
        width: of the map.
        max_regions: more are refused.

    Returns:
        (H, W) int64.

    Raises:
        CodecError: the bytes are no such map.

    Example:
        >>> labels = np.array([[7, 7, 3], [7, 3, 3]])
        >>> (decode_labels(encode_labels(labels), 2, 3, max_regions=2) == labels).all()
        np.True_
    """
    reader = Reader(data)
    ids = _code_ids(reader, [], min(max_regions, height * width))
    if len(ids) == 1:
        return np.full((height, width), ids[0], np.int64)
    if reader.bits(_NOISY, np.zeros(1, np.int32))[0]:
        index = reader.numbers(None, len(ids), height * width).reshape(height, width)
        return cast(Labels, np.array(ids, np.int64)[index])
    starts = np.zeros((height, width), np.uint8)
    index = _code_pixels(reader, np.zeros((0, 0), np.int32), starts, len(ids))
    return cast(Labels, np.array(ids, np.int64)[index])


def compact(labels: Labels) -> tuple[Any, Any]:
    """Return the sorted ids, and each pixel's position among them."""
    highest = int(labels.max())
    if highest < _TABLE:
        present = np.zeros(highest + 1, np.bool_)
        present[labels] = True
        return np.flatnonzero(present), (np.cumsum(present, dtype=np.int32) - 1)[labels]
    ids, index = np.unique(labels, return_inverse=True)
    return ids, index.reshape(labels.shape).astype(np.int32)


def _code_ids(coder: Coder, ids: list[int], limit: int) -> list[int]:
    """Code the ids in the order in which regions are numbered; a reader gives none."""
    extra = 0
    while fair(coder, len(ids) >= 2 << extra):
        extra += 1
        if extra == _MOST:
            raise CodecError(f"data must hold at most {limit} regions; got {1 << extra} or more")
    count = 1 << extra | plain(coder, len(ids), extra)
    if count > limit:
        raise CodecError(f"data must hold at most {limit} regions; got {count}")
    if not fair(coder, ids != list(range(len(ids)))):
        return list(range(count))
    given, ordered, found, last = sorted(ids), [], [], -1
    for i in range(count):
        last += 1 + magnitude(coder, 0 if coder.reads else given[i] - last - 1)
        ordered.append(last)
    if last >= 1 << 63:
        raise CodecError(f"data must hold ids below 2**63; got {last}")
    left, places = _Left(count), {region: i for i, region in enumerate(given)}
    for i in range(count):
        rank = uniform(coder, 0 if coder.reads else left.rank(places[ids[i]]), count - i)
        if rank >= count - i:
            raise CodecError(f"data must name one of {count - i} ids that are left; got number {rank}")
        found.append(ordered[left.take(rank)])
    return found


class _Left:
    """Which of so many things in order are left: a tree of counts, so that millions take seconds."""

    def __init__(self, count: int) -> None:
        self._tree = [i & -i for i in range(count + 1)]

    def rank(self, place: int) -> int:
        """Return how many are left before the one at `place`."""
        total = 0
        while place:
            total += self._tree[place]
            place &= place - 1
        return total

    def take(self, rank: int) -> int:
        """Remove the one that so many are left before; return its place."""
        place, step = 0, 1 << len(self._tree).bit_length()
        while step := step >> 1:
            if place + step >= len(self._tree):
                continue
            if self._tree[place + step] <= rank:
                place += step
                rank -= self._tree[place]
            else:
                self._tree[place + step] -= 1
        return place


def _code_pixels(coder: Coder, truth: Any, starts: Any, regions: int) -> Any:
    """Code a map of numbered regions; a reader ignores `truth` and fills in `starts`."""
    run = loops()
    code_starts(coder, starts)
    height, width = starts.shape
    tables, work = new_tables(), new_work(height)
    labels = np.zeros((height + TOP + 1, width + LEFT + RIGHT), np.int32)
    state = np.zeros(STATE, np.int64)
    state[REGIONS] = regions
    memory = (state, labels, starts, *tables, *work)
    escapes = _Escapes(coder, run, labels, regions)
    answers = np.zeros(2 * height, np.int32)
    bits, asked = answers[:0], 0
    while rows := run.advance(bits, *memory):
        decided = int(state[DECIDED])
        used = decided if regions == 2 else 2 * decided
        asked += decided
        if asked > _MOST_ASKED:
            raise _Laborious(f"data must ask for at most {_MOST_ASKED} pixels near contours; got more")
        if not coder.reads:
            run.answer(state, truth, work.rows, answers)
        if used:
            bits = coder.bits(work.chances[:used], answers[:used])
        if regions > 2 and (rows > decided or np.count_nonzero(bits[:decided])):
            escapes.code(work.rows[:rows], bits[:decided] != 0)
    return labels[TOP : TOP + height, LEFT : LEFT + width]


class _Laborious(CodecError):
    """A map that would take minutes to read."""


class _Escapes:
    """Labels of pixels that are neither candidate."""

    def __init__(self, coder: Coder, run: Loops, labels: Any, regions: int) -> None:
        self._coder, self._run, self._labels, self._regions = coder, run, labels, regions
        self._met, self._count = 1, 0
        self._new = [Counter(2), Counter(2)]
        self._rank = [[Counter(2) for _ in range(RANKS)] for _ in range(2)]
        self._found = np.zeros(RANKS, np.int32)

    def code(self, rows: Any, neither: Any) -> None:
        """Code the labels of a wave."""
        asked = rows[:, CODED] == 0
        asked[~asked] = neither
        self._count += int(asked.sum())
        if self._count > _MOST_ESCAPES:
            raise _Laborious(f"data must hold at most {_MOST_ESCAPES} labels that no neighbour has; got more")
        for at in np.flatnonzero(asked):
            rows[at, LABEL] = self._code(rows[at])

    def _code(self, row: Any) -> int:
        label, coded = int(row[LABEL]), int(row[CODED])
        if self._met < self._regions and self._new[coded].code(self._coder, label == self._met):
            self._met += 1
            return self._met - 1
        for rank in range(self._run.nearest(self._labels, row, self._found)):
            guess = int(self._found[rank])
            if self._rank[coded][rank].code(self._coder, label == guess):
                return guess
        return uniform(self._coder, label, self._met)
