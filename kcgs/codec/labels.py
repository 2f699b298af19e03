"""Label maps without loss."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .contexts import (
    CODED, DECIDED, FIRST, LABEL, LEFT, RANKS, REGIONS, RIGHT, ROWS, STATE, TOP, loops, new_tables, new_work,
)
from .rangecoder import ONE, CodecError, Coder, Reader, Writer, flag, magnitude, plain, uniform

Labels = NDArray[np.int64]
_HALF = ONE // 2
_TABLE = 1 << 20  # ids below it are looked up, not sorted


def encode_labels(labels: Labels) -> bytes:
    """Write a map."""
    ids, index = _compact(labels)
    writer = Writer()
    if len(ids) == 1:
        _code_ids(writer, ids.tolist(), 1)
        return writer.finish()
    truth, events, order = loops().survey(index, len(ids))
    _code_ids(writer, ids[order].tolist(), len(ids))
    _code_map(writer, truth, events, len(ids))
    return writer.finish()


def decode_labels(data: bytes, height: int, width: int, *, max_regions: int) -> Labels:
    """Read a map."""
    reader = Reader(data)
    ids = _code_ids(reader, [], min(max_regions, height * width))
    if len(ids) == 1:
        return np.full((height, width), ids[0], np.int64)
    events = np.zeros((height, width), np.uint8)
    return np.array(ids, np.int64)[_code_map(reader, None, events, len(ids))]


def _compact(labels: Labels) -> tuple[Any, Any]:
    """Return the ids in order and each pixel's position among them."""
    highest = int(labels.max())
    if highest < _TABLE:
        present = np.zeros(highest + 1, np.bool_)
        present[labels] = True
        return np.flatnonzero(present), (np.cumsum(present, dtype=np.int32) - 1)[labels]
    ids, index = np.unique(labels, return_inverse=True)
    return ids, index.reshape(labels.shape).astype(np.int32)


def _code_ids(coder: Coder, ids: list[int], limit: int) -> list[int]:
    """Code the ids in the order in which regions are numbered."""
    extra = 0
    while flag(coder, int(len(ids) >= 2 << extra), _HALF):
        extra += 1
        if extra > 24:
            break
    count = 1 << extra | plain(coder, len(ids), extra)
    if count > limit:
        raise CodecError(f"data must hold at most {limit} regions; got {count}")
    if not flag(coder, int(ids != list(range(len(ids)))), _HALF):
        return list(range(count))
    known, rest, last = sorted(ids), [], -1
    for i in range(count):
        last += 1 + magnitude(coder, known[i] - last - 1 if known else 0)
        rest.append(last)
    if last >= 1 << 63:
        raise CodecError(f"data must hold ids below 2**63; got {last}")
    result = []
    for i in range(count):
        result.append(rest.pop(uniform(coder, rest.index(ids[i]) if known else 0, count - i)))
    return result


def _code_events(coder: Coder, events: Any) -> None:
    """Code which pixels differ from uniform surroundings: how many, then by halves of the picture how many in each."""
    height, width = events.shape
    count = magnitude(coder, int(np.count_nonzero(events)))
    if count > height * width:
        raise CodecError(f"data must mark at most {height * width} pixels; got {count}")
    urn = [_Counter(0.5) for _ in range(8)]
    waiting = [(0, height, 0, width, count)] if count else []
    while waiting:
        top, bottom, left, right, count = waiting.pop()
        tall = bottom - top >= right - left
        if count == 1:
            block = events[top:bottom, left:right]
            at = 0 if coder.reads else int(block.argmax())
            at = top * 0 + uniform(coder, (0 if coder.reads else int(np.flatnonzero(block)[0])), block.size)
            if at >= block.size:
                raise CodecError("data must mark pixels in the map")
            events[top + at // (right - left), left + at % (right - left)] = 1
            continue
        middle = (top + bottom) // 2 if tall else (left + right) // 2
        a, b = ((top, middle, left, right), (middle, bottom, left, right)) if tall else ((top, bottom, left, middle), (top, bottom, middle, right))
        size_a, size_b = ((x[1] - x[0]) * (x[3] - x[2]) for x in (a, b))
        n = 0 if coder.reads else int(np.count_nonzero(events[a[0]:a[1], a[2]:a[3]]))
        low, high = max(0, count - size_b), min(count, size_a)
        if low > high:
            raise CodecError("data must mark pixels in the map")
        context = min(count.bit_length() - 2, 7)
        if urn[context].code(coder, int(n in (low, high))):
            n = (low, high)[flag(coder, int(n == high), _HALF)]
        else:
            if high - low < 2:
                raise CodecError("x")
            n = low + 1 + uniform(coder, n - low - 1, high - low - 1)
        for box, k in ((a, n), (b, count - n)):
            if k:
                waiting.append((*box, k))


class _Counter:
    """An adaptive bit."""

    def __init__(self, chance):
        self.ones, self.all = round(chance * 4), 4

    def code(self, coder, value):
        bit = flag(coder, value, min(max((self.ones << 16) // self.all, 64), ONE - 64))
        self.ones += 2 * bit
        self.all += 2
        return bit


def _code_map(coder: Coder, truth, events, regions: int):
    run = loops()
    _code_events(coder, events)
    height, width = events.shape
    tables, work = new_tables(), new_work(height)
    labels = np.zeros((height + TOP + 1, width + LEFT + RIGHT), np.int32)
    state = np.zeros(STATE, np.int64)
    state[REGIONS] = regions
    escapes = _Escapes(coder, run, labels, regions)
    while rows := run.advance(state, labels, events, tables, work):
        decided = int(state[DECIDED])
        used = decided if regions == 2 else 2 * decided
        if truth is not None:
            run.answer(state, truth, work)
        if used:
            work.bits[:used] = coder.bits(work.chances[:used], work.bits[:used])
        if rows > decided or (regions > 2 and work.bits[:decided].any()):
            escapes.code(work.rows[:rows], work.bits[:decided])
    return labels[TOP : TOP + height, LEFT : LEFT + width]


class _Escapes:
    def __init__(self, coder, run, labels, regions):
        self.coder, self.run, self.labels, self.regions, self.seen = coder, run, labels, regions, 1
        self.new = [_Counter(.5), _Counter(.5)]
        self.rank = [_Counter(.5) for _ in range(2 * RANKS)]
        self.found = np.zeros(RANKS, np.int32)

    def code(self, rows, bits):
        open_ = rows[:, CODED] == 0
        open_[~open_] = bits != 0
        for row in rows[open_]:
            row_label = int(row[LABEL])
            row[LABEL] = self.label(row, row_label, int(row[CODED]))
        # rows[open_] is a copy
            rows[(rows[:, 0] == row[0]) & (rows[:, 1] == row[1])] = row

    def label(self, row, label, coded):
        if self.seen < self.regions and self.new[coded].code(self.coder, int(label == self.seen)):
            self.seen += 1
            return self.seen - 1
        for j in range(self.run.nearest(self.labels, row, self.found)):
            guess = int(self.found[j])
            if self.rank[j + RANKS * coded].code(self.coder, int(label == guess)):
                return guess
        return self.coder.number(label, self.seen)
