"""The loops of label maps that follow a predicted one: where a map deviates from it, and with what chance.

A pixel is asked for where the predicted map has a contour near, or where an earlier neighbour deviates from it
(docs/format.md, "Label maps that follow").
"""

from __future__ import annotations

from importlib import resources
from typing import Any

import numpy as np

from kcgs.kernels.compiled import Program, inner

from .contexts import (
    CLIP,
    CODED,
    DECISION,
    FEATURE,
    FIRST,
    HEADS,
    INPUT,
    INPUTS,
    LABEL,
    SECOND,
    SLOT,
    X,
    Y,
    learn,
    mix,
)

MARGIN = 5  # around the maps: how far the templates reach
SLANT = 4  # pixels (x, y) of equal x + SLANT * y make a wavefront
_BAND = 4  # pixels, in x and in y, within which a contour of the predicted map is near
# earlier pixels, and pixels of the predicted map, that the network sees
_REACH = ((-5, -1), (-5, 3), (-4, 4), (-3, 3), (-2, 2))
_EARLIER = [(dx, -dy) for dy, (low, high) in enumerate(_REACH) for dx in range(low, high + 1)]
_AROUND = [(dx, dy) for dy in range(-4, 5) for dx in range(-4, 5) if 0 < dx**2 + dy**2 <= 18]


def _nearest_first(places: list[tuple[int, int]]) -> list[tuple[int, int]]:
    return sorted(places, key=lambda place: (place[0] ** 2 + place[1] ** 2, -place[1], place[0]))


EARLIER, AROUND = _nearest_first(_EARLIER), _nearest_first(_AROUND)
_EX, _EY = (np.array(axis, np.int32) for axis in zip(*EARLIER, strict=True))
_AX, _AY = (np.array(axis, np.int32) for axis in zip(*AROUND, strict=True))
# later neighbours of a pixel, which are asked for where it deviates
_LATER = ((1, 0), (2, 0), (-2, 1), (-1, 1), (0, 1), (1, 1), (-1, 2), (0, 2))
_LX, _LY = (np.array(axis, np.int32) for axis in zip(*_LATER, strict=True))

_HIDDEN, _LATENT = 32, 16
# weights in 1/64, biases of the second and third layer in 1/4096, as of the network of maps that stand alone
NETWORK = (
    ("<i1", (2 * len(EARLIER) + len(AROUND), _HIDDEN)),
    ("<i2", (_HIDDEN,)),
    ("<i1", (_HIDDEN, _LATENT)),
    ("<i4", (_LATENT,)),
    ("<i1", (_LATENT,)),
    ("<i4", (1,)),
)
ROW = FEATURE + _LATENT + _HIDDEN
# entries of the state: regions in all, the wavefront, its rows, those that bits decide, pixels asked for so far, and
# how many labels of the list were used
REGIONS, FRONT, ROWS, DECIDED, ASKED, USED, STATE = 0, 1, 2, 3, 4, 5, 6
# where the counters of each context begin
_BASES = np.array([[0, 1 << 8, (1 << 8) + (1 << 15)], [98560, 98561, 98570]], np.int32)
_SLOTS = 98570 + 3**6
_MIXER = (46000, 7000, 7000, 8000)  # in 1/65536
_RARE = -512  # logit at first of a label that is neither candidate

program = Program("coder of labels that follow", __name__, __file__, "contexts.py", "prior.bin", "deviation.py")


def load_network() -> tuple[Any, ...]:
    """Read the tables that come with the package, as int32."""
    data = resources.files(__package__).joinpath("deviation.bin").read_bytes()
    tables = np.frombuffer(data, [("", kind, shape) for kind, shape in NETWORK])[0]
    return tuple(table.astype(np.int32) for table in tables)


def new_counters() -> tuple[Any, Any]:
    """Return what adapts: counters [slots, 2] uint16, and the mixer's weights [HEADS, 4, INPUTS]."""
    return np.zeros((_SLOTS, 2), np.uint16), np.tile(np.array(_MIXER, np.int32), (HEADS, 4, 1))


@inner
def _mark_later(asked, y, x):  # type: ignore[no-untyped-def]
    for k in range(len(_LX)):
        i, j = y + _LY[k], x + _LX[k]
        if i < asked.shape[0] and 0 <= j < asked.shape[1]:
            asked[i, j] = 1


@inner
def _describe(labels, predicted, y, x, row):  # type: ignore[no-untyped-def]
    """Find the candidates: the predicted label, and the nearest other one."""
    first = predicted[y, x]
    row[X], row[Y], row[CODED], row[FIRST], row[SECOND] = x, y, 1, first, -1
    for t in range(len(_EX)):
        if labels[y + _EY[t], x + _EX[t]] != first:
            row[SECOND] = labels[y + _EY[t], x + _EX[t]]
            return
    for t in range(len(_AX)):
        if predicted[y + _AY[t], x + _AX[t]] != first:
            row[SECOND] = predicted[y + _AY[t], x + _AX[t]]
            return


@inner
def _add(hidden, weights):  # type: ignore[no-untyped-def]
    for h in range(len(hidden)):
        hidden[h] += weights[h]


@inner
def _estimate(labels, predicted, row, layer1, bias1, layer2, bias2, layer3, bias3):  # type: ignore[no-untyped-def]
    """Give the first estimates: of decision 0, the pixel deviates, by the network."""
    x, y, first = row[X], row[Y], row[FIRST]
    latent, hidden = row[FEATURE : FEATURE + len(bias2)], row[FEATURE + len(bias2) :]
    hidden[:], latent[:] = bias1, bias2
    for t in range(len(_EX)):
        label = labels[y + _EY[t], x + _EX[t]]
        if label != first:
            _add(hidden, layer1[t])
        if label != predicted[y + _EY[t], x + _EX[t]]:
            _add(hidden, layer1[len(_EX) + len(_AX) + t])
    for t in range(len(_AX)):
        if predicted[y + _AY[t], x + _AX[t]] != first:
            _add(hidden, layer1[len(_EX) + t])
    for h in range(len(hidden)):
        value = min(hidden[h], 4095)
        if value > 0:
            weights = layer2[h]
            for k in range(len(latent)):
                latent[k] += value * weights[k]
    total = bias3[0]
    for k in range(len(latent)):
        total += min(max(latent[k] >> 6, 0), 4095) * layer3[k]
    row[INPUT] = min(max(total >> 4, -CLIP), CLIP)
    row[INPUT + INPUTS] = _RARE


@inner
def _choose_counters(labels, predicted, row):  # type: ignore[no-untyped-def]
    """Find the counters of both decisions by the nearest places of the templates."""
    x, y, first, second = row[X], row[Y], row[FIRST], row[SECOND]
    deviates, unlike, around, digits, few = 0, 0, 0, 0, 0
    for t in range(7):
        label = labels[y + _EY[t], x + _EX[t]]
        deviates |= (label != predicted[y + _EY[t], x + _EX[t]]) << t
        unlike |= (label != first) << t
        if t < 4:
            digits = 3 * digits + (0 if label == first else 1 if label == second else 2)
            few = digits if t < 2 else few
    for t in range(10):
        label = predicted[y + _AY[t], x + _AX[t]]
        around |= (label != first) << t
        if t < 2:
            digits = 3 * digits + (0 if label == first else 1 if label == second else 2)
    row[SLOT] = _BASES[0, 0] + ((deviates & 15) << 4 | around & 15)
    row[SLOT + 1] = _BASES[0, 1] + (deviates << 8 | around & 255)
    row[SLOT + 2] = _BASES[0, 2] + ((unlike & 63) << 10 | around)
    row[SLOT + DECISION] = _BASES[1, 0]
    row[SLOT + DECISION + 1] = _BASES[1, 1] + few
    row[SLOT + DECISION + 2] = _BASES[1, 2] + digits


@inner
def _settle(bits, others, state, truth, listed, labels, asked, rows, counters, weights):  # type: ignore[no-untyped-def]
    """Give the wavefront's pixels their labels and learn from them; a writer lists those that no bits say."""
    decided, second = 0, 0
    for n in range(state[ROWS]):
        row = rows[n]
        x, y, label, say = row[X], row[Y], row[FIRST], row[CODED] == 0
        if row[CODED]:
            bit = bits[decided]
            decided += 1
            learn(counters, weights, row, 0, bit)
            if bit:
                say = row[SECOND] < 0
                label = row[SECOND]
                if state[REGIONS] > 2 and not say:
                    say = others[second] != 0
                    learn(counters, weights, row, 1, others[second])
                    second += 1
        if say and state[REGIONS] == 2:
            label = 1 - row[FIRST]
        elif say:
            if len(truth) > 0:
                listed[state[USED]] = truth[y - MARGIN, x - MARGIN]
            # a list that ends early is noticed by how many labels were used
            label = listed[state[USED]] if state[USED] < len(listed) else row[FIRST]
            state[USED] += 1
        if label != row[FIRST]:
            labels[y, x] = label
            _mark_later(asked, y - MARGIN, x - MARGIN)


@program.entry
def advance(  # type: ignore[no-untyped-def]
    bits,
    others,
    state,
    truth,
    listed,
    labels,
    predicted,
    seeds,
    asked,
    rows,
    counters,
    weights,
    network,
    chances,
    answers,
):
    """Take the bits of a wavefront in, go on to the next that has rows and return their number.

    Chances, and answers where the truth is known, are of the bits that say whether a pixel deviates.
    """
    _settle(bits, others, state, truth, listed, labels, asked, rows, counters, weights)
    height, width = seeds.shape
    state[ROWS], state[DECIDED] = 0, 0
    while state[ROWS] == 0 and state[FRONT] < width - 1 + SLANT * (height - 1):
        state[FRONT] += 1
        front = state[FRONT]
        for i in range(max(0, -((width - 1 - front) // SLANT)), min(height - 1, front // SLANT) + 1):
            j = front - SLANT * i
            if not asked[i, j] and not seeds[i, j]:
                continue
            row = rows[state[ROWS]]
            state[ROWS] += 1
            y, x = i + MARGIN, j + MARGIN
            if asked[i, j]:
                _describe(labels, predicted, y, x, row)
                _estimate(labels, predicted, row, *network)
                _choose_counters(labels, predicted, row)
                chances[state[DECIDED]] = mix(counters, weights, row, 0)
                if len(truth) > 0:
                    row[LABEL] = truth[i, j]
                    answers[state[DECIDED]] = row[LABEL] != row[FIRST]
                state[DECIDED] += 1
            else:
                row[X], row[Y], row[CODED], row[FIRST] = x, y, 0, predicted[y, x]
    state[ASKED] += state[DECIDED]
    return state[ROWS]


@program.entry
def ask_others(bits, state, rows, counters, weights, chances, answers):  # type: ignore[no-untyped-def]
    """Fill in the chances that pixels which deviate have not the second candidate either; return their number."""
    decided, count = 0, 0
    for n in range(state[ROWS]):
        row = rows[n]
        if row[CODED]:
            if bits[decided] and row[SECOND] >= 0:
                chances[count] = mix(counters, weights, row, 1)
                answers[count] = row[LABEL] != row[SECOND]
                count += 1
            decided += 1
    return count


@program.entry
def mark_band(predicted, asked):  # type: ignore[no-untyped-def]
    """Mark the pixels that have a contour of the predicted map (H, W) near."""
    height, width = asked.shape
    for i in range(height):
        for j in range(width):
            top, left = max(0, i - _BAND), max(0, j - _BAND)
            if j + 1 < width and predicted[i, j] != predicted[i, j + 1]:
                asked[top : i + _BAND + 1, max(0, j + 1 - _BAND) : j + _BAND + 1] = 1
            if i + 1 < height and predicted[i, j] != predicted[i + 1, j]:
                asked[max(0, i + 1 - _BAND) : i + _BAND + 1, left : j + _BAND + 1] = 1


@program.entry
def find_seeds(truth, predicted, asked, seeds):  # type: ignore[no-untyped-def]
    """Mark the pixels that deviate where none is asked for; return how many are asked for."""
    count = 0
    for i in range(seeds.shape[0]):
        for j in range(seeds.shape[1]):
            count += asked[i, j]
            if truth[i, j] != predicted[i, j]:
                seeds[i, j] = 1 - asked[i, j]
                _mark_later(asked, i, j)
    return count


@program.part
def deviations() -> None:
    """Compile what goes from wavefront to wavefront."""
    bits, state, index = np.zeros(4, np.int32), np.zeros(STATE, np.int64), np.zeros((2, 2), np.int32)
    state[REGIONS] = 3
    padded, marks, rows = np.zeros((12, 12), np.int32), np.zeros((2, 2), np.uint8), np.zeros((2, ROW), np.int32)
    network = tuple(np.zeros(shape, np.int32) for _, shape in NETWORK)
    memory, chances = new_counters(), np.zeros(4)
    advance(bits, bits, state, index, bits, padded, padded, marks, marks, rows, *memory, network, chances, bits)
    ask_others(bits, state, rows, *memory, chances, bits)


@program.part
def surveys() -> None:
    """Compile what looks at whole maps."""
    index, marks = np.zeros((2, 2), np.int32), np.zeros((2, 2), np.uint8)
    mark_band(index, marks)
    find_seeds(index, index, marks, marks)
