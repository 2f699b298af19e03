"""A label map from wavefront to wavefront: which pixels are to be decided, with what chances, and what follows.

A wavefront is the pixels of equal x + 8 y; what it asks depends on earlier ones only (docs/format.md). Rows continue
with their last label until a decision changes it, so that only pixels near contours are looked at.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.kernels.compiled import Program, inner

from .contexts import (
    CODED,
    FIRST,
    LABEL,
    LEFT,
    RIGHT,
    SECOND,
    TOP,
    UNITS,
    X,
    Y,
    contexts,
    describe,
    learn,
    mix,
    network,
    network2,
    quiet,
)

SLANT = 8  # pixels (x, y) of equal x + SLANT * y make a wavefront
RANKS = 3  # nearest labels that one that is neither candidate is compared with
_FAR = 32  # pixels within which they are looked for
# entries of the state: the wavefront, its rows, those of them that bits decide; regions in all; whether the network is
# that of files of maps
FRONT, ROWS, DECIDED, REGIONS, WIDE, STATE = 0, 1, 2, 3, 4, 5
# of a row of the map: its last pixel that differs from the one before, the next seed, the wavefront until which it is
# quiet, how far its last label is written
_CHANGE, _SEED, _WAKE, _END, _LINE = 0, 1, 2, 3, 4
_AHEAD = 128  # pixels that a row is written at a time: to its end, a change would cost its width


def new_work(height: int, prior: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """Return room for the pixels of a wavefront, the chances of their bits, and what is known of the map's rows."""
    lines = np.zeros((TOP + height + 2, _LINE), np.int32)
    return np.zeros((height, UNITS + sum(prior[2].shape)), np.int32), np.zeros(2 * height), lines


@inner
def _still(labels, y, x, lines):  # type: ignore[no-untyped-def]
    """Tell the same as `quiet`, by the last change in each row, which in the row above is not beyond what it reads."""
    if y < TOP + 2:
        return quiet(labels, y, x)
    label = labels[y, x - 1]
    if lines[y, _CHANGE] > x - 2 or lines[y - 1, _CHANGE] > x - 2:
        return False
    if labels[y - 1, x] != label or labels[y - 2, x] != label:
        return False
    return lines[y - 2, _CHANGE] < x or quiet(labels, y, x)


@inner
def _continue(labels, y, x, label, lines):  # type: ignore[no-untyped-def]
    labels[y, x : x + _AHEAD] = label
    lines[y, _END] = x + _AHEAD


@inner
def _margins(labels, y, x, label):  # type: ignore[no-untyped-def]
    """Repeat the label of a pixel in the margins above and left of the map."""
    if y == TOP:
        labels[:TOP, x : x + RIGHT + 1] = label
    if x == LEFT:
        labels[y + 1, :LEFT] = label


@inner
def _settle(state, labels, bits, counters, weights, rows, lines):  # type: ignore[no-untyped-def]
    """Give the wavefront's pixels their labels and learn from them."""
    decided = state[DECIDED]
    escapes = decided if state[REGIONS] > 2 else 0
    asked = 0
    for n in range(state[ROWS]):
        row = rows[n]
        if row[CODED]:
            escaped = False
            if escapes > 0:
                escaped = bits[asked] != 0
                learn(counters, weights, row, 1, bits[asked])
            if not escaped:
                bit = bits[escapes + asked]
                learn(counters, weights, row, 0, bit)
                row[LABEL] = row[SECOND] if bit else row[FIRST]
            asked += 1
        y, x, label = row[Y], row[X], row[LABEL]
        if label != labels[y, x - 1]:
            lines[y, _CHANGE] = x
            lines[y : y + 3, _WAKE] = 0  # these rows see it
            _continue(labels, y, x, label, lines)
        _margins(labels, y, x, label)


@inner
def _look(state, labels, seeds, rows, lines):  # type: ignore[no-untyped-def]
    """List the pixels of a wavefront that are to be decided; the others have their label, since rows continue."""
    height, width = seeds.shape
    front = state[FRONT]
    for j in range(max(0, -((width - 1 - front) // SLANT)), min(height - 1, front // SLANT) + 1):
        x, y = front - SLANT * j + LEFT, j + TOP
        line = lines[y]
        if x + RIGHT >= line[_END]:
            _continue(labels, y, x, labels[y, x - 1], lines)
        if line[_WAKE] > front:
            continue
        seed = max(line[_SEED], x)
        while seed < width + LEFT and seeds[j, seed - LEFT] == 0:
            seed += 1
        line[_SEED] = seed
        n = state[ROWS]
        row = rows[n]
        if not _still(labels, y, x, lines):
            describe(labels, y, x, row)
            row[X], row[Y], row[CODED] = x, y, 1
            state[ROWS] += 1
            state[DECIDED] += 1
        elif x == seed:
            row[X], row[Y], row[CODED], row[FIRST], row[SECOND] = x, y, 0, labels[y, x - 1], -1
            row[LABEL] = 1 - row[FIRST]  # unless there are more than two regions
            state[ROWS] += 1
        else:
            _margins(labels, y, x, labels[y, x - 1])
            if y >= TOP + 2 and lines[y - 2, _CHANGE] < x:
                line[_WAKE] = front + seed - x


@inner
def _weigh(truth, answers, state, counters, weights, rows, chances):  # type: ignore[no-untyped-def]
    """Fill in the chances, and answers where the truth is known: first of being neither candidate, then the second."""
    escapes = state[DECIDED] if state[REGIONS] > 2 else 0
    asked = 0
    for n in range(state[ROWS]):
        row = rows[n]
        if len(truth) > 0:
            row[LABEL] = truth[row[Y] - TOP, row[X] - LEFT]
        if row[CODED]:
            if state[WIDE]:
                network2(row)
            else:
                network(row)
            contexts(row)
            if escapes > 0:
                chances[asked] = mix(counters, weights, row, 1)
                answers[asked] = row[LABEL] != row[FIRST] and row[LABEL] != row[SECOND]
            chances[escapes + asked] = mix(counters, weights, row, 0)
            answers[escapes + asked] = row[LABEL] != row[FIRST]
            asked += 1


program = Program("label coder", __file__, "contexts.py", "prior.bin", "prior2.bin")


@program.entry
def advance(bits, truth, answers, state, labels, seeds, counters, weights, rows, chances, lines):  # type: ignore[no-untyped-def]
    """Take the bits of a wavefront in, go on to the next that has questions and return their number."""
    height, width = seeds.shape
    _settle(state, labels, bits, counters, weights, rows, lines)
    state[ROWS] = 0
    state[DECIDED] = 0
    while state[ROWS] == 0 and state[FRONT] < width - 1 + SLANT * (height - 1):
        state[FRONT] += 1
        _look(state, labels, seeds, rows, lines)
    _weigh(truth, answers, state, counters, weights, rows, chances)
    return state[ROWS]


@program.entry
def nearest(labels, row, found):  # type: ignore[no-untyped-def]
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


@program.entry
def survey(index, regions):  # type: ignore[no-untyped-def]
    """Number the labels in the order in which wavefronts meet them; mark pixels unlike their uniform surroundings."""
    height, width = index.shape
    number = np.full(regions, -1, np.int32)
    order = np.empty(regions, np.int32)
    count = 0
    for front in range(width + SLANT * (height - 1)):
        for j in range(max(0, -((width - 1 - front) // SLANT)), min(height - 1, front // SLANT) + 1):
            label = index[j, front - SLANT * j]
            if number[label] < 0:
                number[label] = count
                order[count] = label
                count += 1
        if count == regions:
            break
    truth = np.empty(index.shape, np.int32)
    seeds = np.zeros(index.shape, np.uint8)
    labels = np.zeros((height + TOP + 1, width + LEFT + RIGHT), np.int32)
    for j in range(height):
        for i in range(width):
            x, y = i + LEFT, j + TOP
            truth[j, i] = number[index[j, i]]
            seeds[j, i] = truth[j, i] != labels[y, x - 1] and quiet(labels, y, x)
            labels[y, x] = truth[j, i]
            _margins(labels, y, x, truth[j, i])
        labels[y, LEFT + width :] = truth[j, width - 1]
    return truth, seeds, order
