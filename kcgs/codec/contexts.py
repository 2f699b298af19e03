"""The model of label maps: what a pixel may be, given the pixels before it. Loops in integers, compiled by numba.

Everything that a decoder must reproduce is here and in `prior`; the stream itself is specified in `labels`.
"""

from __future__ import annotations

import functools
import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numba import njit

from .prior import HIDDEN, LATENT, TEMPLATE, Prior, load_prior

log = logging.getLogger("kcgs")

SLANT = 3  # pixels (x, y) of equal x + SLANT * y make a wave
LEFT, RIGHT, TOP = 8, 8, 6  # margins around the map
CLIP = 3071  # largest logit, in 1/256
HEADS, INPUTS = 2, 4  # decisions: which of two candidates, or neither; estimates that are mixed
RANKS = 3  # nearest labels that one that is neither candidate is compared with
# columns of a pixel's row: its place, the candidates, whether it is decided by bits, its label
X, Y, FIRST, SECOND, CODED, LABEL, COLUMNS = 0, 1, 2, 3, 4, 5, 6
# entries of the state: the wave, its rows, those of them that bits decide; regions in all
WAVE, ROWS, DECIDED, REGIONS, STATE = 0, 1, 2, 3, 4

# where the counters of each context begin
_BASES = np.array([[0, 1 << 6, (1 << 6) + (1 << 11)], [67648, 67649, 67649 + 3**4]], np.int32)
_SLOTS = 67649 + 3**4 + 3**8
_LEARNING, _SHIFT = 6, 22  # the mixer's step
_MEMORY = 30  # decisions that a counter remembers
_SURE = 16  # least chance, in 1/65536


class Tables(NamedTuple):
    """What adapts, and constants; all integers."""

    dx: Any  # [T] int32, the template
    dy: Any
    bases: Any  # [HEADS, 3] int32
    prior: Prior
    squash: Any  # [2 * CLIP + 1] int32: 65536 / (1 + e^(-x / 256))
    stretch: Any  # [4096] int32: its inverse
    chance: Any  # [slots] uint16, 1/65536
    seen: Any  # [slots] uint8
    weights: Any  # [HEADS, 4, INPUTS] int32, 1/65536


class Work(NamedTuple):
    """What belongs to the pixels of one wave."""

    rows: Any  # [H, COLUMNS] int32
    chances: Any  # [2 * H] float64, of a bit that is 1
    bits: Any  # [2 * H] int32
    features: Any  # [H, T] int8: 0 the first candidate, 1 the second, 2 another
    inputs: Any  # [H, HEADS, INPUTS] int32
    slots: Any  # [H, HEADS, 3] int32
    mixed: Any  # [H, HEADS] int32
    chosen: Any  # [H, HEADS] int32


def new_tables() -> Tables:
    """Return what every stream starts with."""
    prior = load_prior()
    logits = np.arange(-CLIP, CLIP + 1) / 256
    # no value is within 1e-6 of a half, so that every machine's exp rounds to the same table
    squash = np.rint(65536 / (1 + np.exp(-logits))).astype(np.int32)
    stretch = np.searchsorted(squash, np.arange(4096) * 16 + 8) - CLIP
    dx, dy = (np.array(axis, np.int32) for axis in zip(*TEMPLATE, strict=True))
    weights = np.empty((HEADS, 4, INPUTS), np.int32)
    weights[:] = prior.mixer
    chance, seen = np.zeros(_SLOTS, np.uint16), np.zeros(_SLOTS, np.uint8)
    return Tables(dx, dy, _BASES, prior, squash, stretch.astype(np.int32), chance, seen, weights)


def new_work(height: int) -> Work:
    """Return room for the pixels of a wave."""
    return Work(
        np.zeros((height, COLUMNS), np.int32),
        np.zeros(2 * height),
        np.zeros(2 * height, np.int32),
        np.zeros((height, len(TEMPLATE)), np.int8),
        np.zeros((height, HEADS, INPUTS), np.int32),
        np.zeros((height, HEADS, 3), np.int32),
        np.zeros((height, HEADS), np.int32),
        np.zeros((height, HEADS), np.int32),
    )


_inner = cast(Any, njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")


@_inner
def _uniform(labels, y, x):  # type: ignore[no-untyped-def]
    """Tell whether the pixels around (x, y) that come before it have one label."""
    label = labels[y, x - 1]
    for i in range(x - 2, x + 3):
        if labels[y - 1, i] != label:
            return False
    for i in range(x - 1, x + 2):
        if labels[y - 2, i] != label:
            return False
    return labels[y, x - 2] == label


@_inner
def _describe(labels, y, x, dx, dy, row, feature):  # type: ignore[no-untyped-def]
    first = labels[y, x - 1]
    second = -1
    for t in range(len(dx)):
        label = labels[y + dy[t], x + dx[t]]
        if label == first:
            feature[t] = 0
        elif second < 0 or label == second:
            second = label
            feature[t] = 1
        else:
            feature[t] = 2
    row[FIRST] = first
    row[SECOND] = second


@_inner
def _network(feature, prior, out):  # type: ignore[no-untyped-def]
    """Two layers of rectified sums of small integers; out: logits in 1/256."""
    hidden = prior.bias1.copy()
    for t in range(len(feature)):
        if feature[t] > 0:
            row = prior.layer1[t, feature[t] - 1]
            for j in range(HIDDEN):
                hidden[j] += row[j]
    latent = prior.bias2.copy()
    for j in range(HIDDEN):
        value = min(hidden[j], 4095)
        if value > 0:
            row = prior.layer2[j]
            for k in range(LATENT):
                latent[k] += value * row[k]
    for h in range(HEADS):
        total = prior.bias3[h]
        for k in range(LATENT):
            total += min(max(latent[k] >> 6, 0), 4095) * prior.layer3[k, h]
        out[h, 0] = min(max(total >> 4, -CLIP), CLIP)


@_inner
def _contexts(feature, bases, slots):  # type: ignore[no-untyped-def]
    bits = 0
    for t in range(1, 17):
        bits = bits << 1 | (feature[t] > 0)
        if t == 6:
            slots[0, 0] = bases[0, 0] + bits
        elif t == 11:
            slots[0, 1] = bases[0, 1] + bits
        elif t == 16:
            slots[0, 2] = bases[0, 2] + bits
    digits = 0
    for t in range(1, 9):
        digits = digits * 3 + feature[t]
        if t == 4:
            slots[1, 1] = bases[1, 1] + digits
        elif t == 8:
            slots[1, 2] = bases[1, 2] + digits
    slots[1, 0] = bases[1, 0]


@_inner
def _mix(tables, work, i, h):  # type: ignore[no-untyped-def]
    """Weigh the network and the counters into one chance."""
    inputs = work.inputs[i, h]
    seen = 0
    for c in range(3):
        slot = work.slots[i, h, c]
        seen = tables.seen[slot]
        inputs[c + 1] = tables.stretch[tables.chance[slot] >> 4] if seen > 0 else inputs[0]
    chosen = 0 if seen == 0 else 1 if seen < 5 else 2 if seen < 12 else 3
    total = np.int64(0)
    for k in range(INPUTS):
        total += np.int64(tables.weights[h, chosen, k]) * inputs[k]
    logit = min(max(total >> 16, -CLIP), CLIP)
    work.chosen[i, h] = chosen
    work.mixed[i, h] = min(max(tables.squash[logit + CLIP], _SURE), 65536 - _SURE)
    return work.mixed[i, h] / 65536


@_inner
def _learn(tables, work, i, h, bit):  # type: ignore[no-untyped-def]
    error = (bit << 16) - work.mixed[i, h]
    weights = tables.weights[h, work.chosen[i, h]]
    for k in range(INPUTS):
        step = np.int64(work.inputs[i, h, k]) * error * _LEARNING
        weights[k] += (step + (1 << (_SHIFT - 1))) >> _SHIFT
    for c in range(3):
        slot = work.slots[i, h, c]
        seen = np.int64(tables.seen[slot])
        chance = np.int64(tables.chance[slot])
        if seen == 0:
            chance = np.int64(tables.squash[work.inputs[i, h, 0] + CLIP])
            seen = 2
        chance += ((bit << 16) - chance) * 2 // (2 * seen + 3)
        tables.chance[slot] = min(max(chance, 32), 65504)
        tables.seen[slot] = min(seen + 1, _MEMORY)


@_inner
def _put(labels, y, x, label, width):  # type: ignore[no-untyped-def]
    """Give a pixel its label, and the margins that repeat it."""
    labels[y, x] = label
    if y == TOP:
        labels[:TOP, x : x + RIGHT + 1] = label
    if x == LEFT + width - 1:
        labels[y, x + 1 :] = label
    if x == LEFT:
        labels[y + 1, :LEFT] = label


@_inner
def _settle(state, labels, width, tables, work):  # type: ignore[no-untyped-def]
    """Give the wave's pixels their labels and learn from them."""
    decided = state[DECIDED]
    escapes = decided if state[REGIONS] > 2 else 0
    at = 0
    for n in range(state[ROWS]):
        row = work.rows[n]
        if row[CODED]:
            escaped = False
            if escapes > 0:
                escaped = work.bits[at] != 0
                _learn(tables, work, n, 1, work.bits[at])
            if not escaped:
                bit = work.bits[escapes + at]
                _learn(tables, work, n, 0, bit)
                row[LABEL] = row[SECOND] if bit else row[FIRST]
            at += 1
        _put(labels, row[Y], row[X], row[LABEL], width)


@_inner
def _look(state, labels, events, tables, work):  # type: ignore[no-untyped-def]
    """List the pixels of a wave that are to be decided; the others get their label."""
    height, width = events.shape
    wave = state[WAVE]
    for j in range(max(0, -((width - 1 - wave) // SLANT)), min(height - 1, wave // SLANT) + 1):
        x, y = wave - SLANT * j + LEFT, j + TOP
        n = state[ROWS]
        row = work.rows[n]
        if not _uniform(labels, y, x):
            _describe(labels, y, x, tables.dx, tables.dy, row, work.features[n])
            row[X], row[Y], row[CODED] = x, y, 1
            state[ROWS] += 1
            state[DECIDED] += 1
        elif events[j, x - LEFT] == 0:
            _put(labels, y, x, labels[y, x - 1], width)
        elif state[REGIONS] == 2:
            _put(labels, y, x, 1 - labels[y, x - 1], width)
        else:
            row[X], row[Y], row[CODED], row[FIRST], row[SECOND] = x, y, 0, labels[y, x - 1], -1
            state[ROWS] += 1


@_inner
def _weigh(state, tables, work):  # type: ignore[no-untyped-def]
    """Fill in the chances: first of being neither candidate, then of being the second."""
    escapes = state[DECIDED] if state[REGIONS] > 2 else 0
    at = 0
    for n in range(state[ROWS]):
        if work.rows[n, CODED]:
            _network(work.features[n], tables.prior, work.inputs[n])
            _contexts(work.features[n], tables.bases, work.slots[n])
            if escapes > 0:
                work.chances[at] = _mix(tables, work, n, 1)
            work.chances[escapes + at] = _mix(tables, work, n, 0)
            at += 1


class Loops(NamedTuple):
    """The compiled entry points."""

    advance: Callable[..., int]
    answer: Callable[..., None]
    nearest: Callable[..., None]
    survey: Callable[..., Any]


def compile_loops(fingerprint: str, cache: bool) -> Loops:
    """Make the entry points; they compile when called and are kept on disk (`cache`) by `fingerprint`."""
    entry = cast(Any, njit)(cache=cache, nogil=True, no_cfunc_wrapper=True, error_model="numpy")

    @entry
    def advance(state, labels, events, tables, work):  # type: ignore[no-untyped-def]
        """Take the answers for a wave in, go on to the next that has questions and return their number."""
        fingerprint  # noqa: B018
        height, width = events.shape
        _settle(state, labels, width, tables, work)
        state[ROWS] = 0
        state[DECIDED] = 0
        while state[ROWS] == 0 and state[WAVE] < width - 1 + SLANT * (height - 1):
            state[WAVE] += 1
            _look(state, labels, events, tables, work)
        _weigh(state, tables, work)
        return state[ROWS]

    @entry
    def answer(state, truth, work):  # type: ignore[no-untyped-def]
        """Look the answers up in a map that is known."""
        fingerprint  # noqa: B018
        escapes = state[DECIDED] if state[REGIONS] > 2 else 0
        at = 0
        for n in range(state[ROWS]):
            row = work.rows[n]
            row[LABEL] = truth[row[Y] - TOP, row[X] - LEFT]
            if row[CODED]:
                if escapes > 0:
                    work.bits[at] = row[LABEL] != row[FIRST] and row[LABEL] != row[SECOND]
                work.bits[escapes + at] = row[LABEL] != row[FIRST]
                at += 1

    @entry
    def nearest(labels, row, found):  # type: ignore[no-untyped-def]
        """List up to RANKS labels other than the candidates, by distance from a pixel; return how many."""
        fingerprint  # noqa: B018
        count = 0
        for radius in range(1, 33):
            for j in range(-radius, 1):
                step = 1 if j == -radius else 2 * radius
                for i in range(-radius, radius + 1, step):
                    y, x = row[Y] + j, row[X] + i
                    if i + SLANT * j >= 0 or y < 0 or x < 0 or x >= labels.shape[1]:
                        continue
                    label = labels[y, x]
                    known = label == row[FIRST] or label == row[SECOND]
                    for k in range(count):
                        known |= found[k] == label
                    if not known:
                        found[count] = label
                        count += 1
                        if count == RANKS:
                            return count
        return count

    @entry
    def survey(index, regions):  # type: ignore[no-untyped-def]
        """Number the labels in the order in which waves meet them; mark pixels unlike their uniform surroundings."""
        fingerprint  # noqa: B018
        height, width = index.shape
        number = np.full(regions, -1, np.int32)
        order = np.empty(regions, np.int32)
        count = 0
        for wave in range(width + SLANT * (height - 1)):
            for j in range(max(0, -((width - 1 - wave) // SLANT)), min(height - 1, wave // SLANT) + 1):
                label = index[j, wave - SLANT * j]
                if number[label] < 0:
                    number[label] = count
                    order[count] = label
                    count += 1
            if count == regions:
                break
        truth = np.empty(index.shape, np.int32)
        events = np.zeros(index.shape, np.uint8)
        labels = np.zeros((height + TOP + 1, width + LEFT + RIGHT), np.int32)
        for j in range(height):
            for i in range(width):
                x, y = i + LEFT, j + TOP
                truth[j, i] = number[index[j, i]]
                events[j, i] = truth[j, i] != labels[y, x - 1] and _uniform(labels, y, x)
                _put(labels, y, x, truth[j, i], width)
        return truth, events, order

    return Loops(advance, answer, nearest, survey)


@functools.cache
def loops() -> Loops:
    """Compile the loops, or load them from disk."""
    digest = hashlib.sha256()
    for name in ("contexts.py", "prior.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    try:
        return compile_loops(digest.hexdigest(), cache=True)
    except RuntimeError:  # numba finds no folder that it may write to
        log.warning("kcgs: no folder to keep the compiled codec in; set NUMBA_CACHE_DIR to one")
        return compile_loops(digest.hexdigest(), cache=False)
