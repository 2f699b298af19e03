"""A map from wave to wave: which pixels are to be decided, with what chances, and what follows from the answers.

The nearest labels of a pixel are found in squares about it, of radius 1 to 32: row by row from the top to its own, in
the top row from left to right, in the others first the pixel at the left, then that at the right. Only pixels of
earlier waves count, by x + 8 y also outside the map, and there those up to 6 rows above it, 8 columns at its left and 9
at its right. The labels that are not the pixel's candidates are listed as they come, each once, up to three. (A start
has one candidate, the label of its neighbours.)
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from numba import njit

from .contexts import (
    CODED,
    COLUMNS,
    DECISION,
    FIRST,
    HEADS,
    INPUTS,
    LABEL,
    LEFT,
    RIGHT,
    SECOND,
    TOP,
    X,
    Y,
    compiled,
    contexts,
    describe,
    inner,
    learn,
    mix,
    network,
    quiet,
)
from .prior import TEMPLATE

SLANT = 8  # pixels (x, y) of equal x + SLANT * y make a wave
RANKS = 3  # nearest labels that one that is neither candidate is compared with
_FAR = 32  # pixels within which they are looked for
# entries of the state: the wave, its rows, those of them that bits decide; regions in all
WAVE, ROWS, DECIDED, REGIONS, STATE = 0, 1, 2, 3, 4


class Work(NamedTuple):
    """What belongs to the pixels of one wave."""

    rows: Any  # [H, COLUMNS] int32
    chances: Any  # [2 * H] float64, of a bit that is 1
    bits: Any  # [2 * H] int32
    features: Any  # [H, T] int8: 0 the first candidate, 1 the second, 2 another
    inputs: Any  # [H, HEADS, INPUTS] int32
    slots: Any  # [H, HEADS, DECISION] int32
    changes: Any  # [TOP + H] int32, the last pixel of each row that differs from the one before


def new_work(height: int) -> Work:
    """Return room for the pixels of a wave."""
    return Work(
        np.zeros((height, COLUMNS), np.int32),
        np.zeros(2 * height),
        np.zeros(2 * height, np.int32),
        np.zeros((height, len(TEMPLATE)), np.int8),
        np.zeros((height, HEADS, INPUTS), np.int32),
        np.zeros((height, HEADS, DECISION), np.int32),
        np.zeros(height + TOP, np.int32),
    )


@inner
def _still(labels, y, x, changes):  # type: ignore[no-untyped-def]
    """Tell the same as `quiet`, by the last change in each row, which in the row above is not beyond what it reads."""
    if y < TOP + 2:
        return quiet(labels, y, x)
    label = labels[y, x - 1]
    if changes[y] > x - 2 or changes[y - 1] > x - 2 or labels[y - 1, x] != label or labels[y - 2, x] != label:
        return False
    return changes[y - 2] < x or quiet(labels, y, x)


@inner
def _set(labels, y, x, label, width, changes):  # type: ignore[no-untyped-def]
    if label != labels[y, x - 1]:
        changes[y] = x
    _put(labels, y, x, label, width)


@inner
def _put(labels, y, x, label, width):  # type: ignore[no-untyped-def]
    """Give a pixel its label, and the margins that repeat it."""
    labels[y, x] = label
    if y == TOP:
        labels[:TOP, x : x + RIGHT + 1] = label
    if x == LEFT + width - 1:
        labels[y, x + 1 :] = label
    if x == LEFT:
        labels[y + 1, :LEFT] = label


@inner
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
                learn(tables, work, n, 1, work.bits[at])
            if not escaped:
                bit = work.bits[escapes + at]
                learn(tables, work, n, 0, bit)
                row[LABEL] = row[SECOND] if bit else row[FIRST]
            at += 1
        _set(labels, row[Y], row[X], row[LABEL], width, work.changes)


@inner
def _look(state, labels, events, work):  # type: ignore[no-untyped-def]
    """List the pixels of a wave that are to be decided; the others get their label."""
    height, width = events.shape
    wave = state[WAVE]
    for j in range(max(0, -((width - 1 - wave) // SLANT)), min(height - 1, wave // SLANT) + 1):
        x, y = wave - SLANT * j + LEFT, j + TOP
        n = state[ROWS]
        row = work.rows[n]
        if not _still(labels, y, x, work.changes):
            describe(labels, y, x, row, work.features[n])
            row[X], row[Y], row[CODED] = x, y, 1
            state[ROWS] += 1
            state[DECIDED] += 1
        elif events[j, x - LEFT] == 0:
            _put(labels, y, x, labels[y, x - 1], width)
        else:
            row[X], row[Y], row[CODED], row[FIRST], row[SECOND] = x, y, 0, labels[y, x - 1], -1
            row[LABEL] = 1 - row[FIRST]  # unless there are more than two regions
            state[ROWS] += 1


@inner
def _weigh(state, tables, work):  # type: ignore[no-untyped-def]
    """Fill in the chances: first of being neither candidate, then of being the second."""
    escapes = state[DECIDED] if state[REGIONS] > 2 else 0
    at = 0
    for n in range(state[ROWS]):
        if work.rows[n, CODED]:
            network(work.features[n], work.inputs[n])
            contexts(work.features[n], work.slots[n])
            if escapes > 0:
                work.chances[at] = mix(tables, work, n, 1)
            work.chances[escapes + at] = mix(tables, work, n, 0)
            at += 1


@inner
def _nearest(labels, row, found):  # type: ignore[no-untyped-def]
    """List up to RANKS labels other than the candidates, by distance from a pixel; return how many."""
    count = 0
    for radius in range(1, _FAR + 1):
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


@inner
def _survey(index, regions):  # type: ignore[no-untyped-def]
    """Number the labels in the order in which waves meet them; mark pixels unlike their uniform surroundings."""
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
            events[j, i] = truth[j, i] != labels[y, x - 1] and quiet(labels, y, x)
            _put(labels, y, x, truth[j, i], width)
    return truth, events, order


@inner
def _answer(state, truth, work):  # type: ignore[no-untyped-def]
    """Look the answers up in a map that is known."""
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


class Loops(NamedTuple):
    """The compiled entry points."""

    advance: Callable[..., int]
    answer: Callable[..., None]
    nearest: Callable[..., int]
    survey: Callable[..., Any]


def _compile(fingerprint: str, cache: bool) -> Loops:
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
            _look(state, labels, events, work)
        _weigh(state, tables, work)
        return state[ROWS]

    @entry
    def answer(state, truth, work):  # type: ignore[no-untyped-def]
        fingerprint  # noqa: B018
        _answer(state, truth, work)

    @entry
    def nearest(labels, row, found):  # type: ignore[no-untyped-def]
        fingerprint  # noqa: B018
        return _nearest(labels, row, found)

    @entry
    def survey(index, regions):  # type: ignore[no-untyped-def]
        fingerprint  # noqa: B018
        return _survey(index, regions)

    return Loops(advance, answer, nearest, survey)


@functools.cache
def loops() -> Loops:
    """Compile the loops, or load them from disk."""
    return cast(Loops, compiled(_compile, "waves.py"))
