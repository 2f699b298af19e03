"""The model of label maps: what a pixel may be, given the pixels before it (docs/format.md, "Chances of a pixel").

A small network, trained once by `tests/codec/train_prior.py`, says what is known before a map is seen. Loops in
integers, compiled by numba: ``>>`` and ``//`` round down.
"""

from __future__ import annotations

from importlib import resources
from typing import Any

import numpy as np

from kcgs.kernels.compiled import inner

# columns of each row above the pixel that the network sees, nearest row first
_REACH = ((-8, -1), (-8, 7), (-7, 8), (-6, 7), (-5, 6), (-3, 4), (-2, 3))
_OFFSETS = [(dx, -dy) for dy, (low, high) in enumerate(_REACH) for dx in range(low, high + 1)]
TEMPLATE = sorted(_OFFSETS, key=lambda place: (place[0] ** 2 + place[1] ** 2, -place[1], place[0]))
# tables of scenes and of files of maps, with the units of their layers; weights are in 1/64, biases of the second and
# third layer in 1/4096, first estimates of the mixer in 1/65536
PRIORS = {"prior.bin": (48, 16), "prior2.bin": (96, 32)}

LEFT, RIGHT, TOP = 8, 9, 6  # margins around the map
CLIP = 3071  # largest logit, in 1/256
HEADS, INPUTS = 2, 4  # decisions: which of two candidates, or neither; estimates that are mixed
# columns of a pixel's row: its place, the candidates, whether it is decided by bits, its label; then for each decision
# the estimates, and the three counters, the mixer's weights, the chance; then the template, and room for the network
X, Y, FIRST, SECOND, CODED, LABEL, INPUT = 0, 1, 2, 3, 4, 5, 6
SLOT = INPUT + HEADS * INPUTS
CHOSEN, MIXED, DECISION = 3, 4, 5
FEATURE = SLOT + HEADS * DECISION
UNITS = FEATURE + len(TEMPLATE)

# where the counters of each context begin
_BASES = np.array([[0, 1 << 6, (1 << 6) + (1 << 11)], [67648, 67649, 67649 + 3**4]], np.int32)
_SLOTS = 67649 + 3**4 + 3**8
_RATE, _SHIFT = 6, 18  # the mixer's step
_HEAVIEST = 1 << 22
_MEMORY = 40  # decisions that a counter remembers
_SURE = 16  # least chance, in 1/65536


def layout(hidden: int, latent: int) -> list[tuple[str, tuple[int, ...]]]:
    """Return type and shape of each table: weights and biases of three layers, then the mixer's first weights."""
    weights = ("<i1", (len(TEMPLATE), 2, hidden)), ("<i1", (hidden, latent)), ("<i1", (latent, HEADS))
    biases = ("<i2", (hidden,)), ("<i4", (latent,)), ("<i4", (HEADS,))
    return [table for layer in zip(weights, biases, strict=True) for table in layer] + [("<i4", (INPUTS,))]


def load_prior(name: str = "prior.bin") -> tuple[Any, ...]:
    """Read tables that come with the package, as int32, in the order of `layout`."""
    data = resources.files(__package__).joinpath(name).read_bytes()
    tables = np.frombuffer(data, [("", kind, shape) for kind, shape in layout(*PRIORS[name])])[0]
    return tuple(table.astype(np.int32) for table in tables)


# constants of the loops: the template, 65536 / (1 + e**(-x / 256)) for logits from -CLIP, its inverse. No value of the
# second but 32768 is within 1e-6 of a half before it is rounded: any machine's exp gives the same table.
_DX, _DY = (np.array(axis, np.int32) for axis in zip(*TEMPLATE, strict=True))
SQUASH = np.rint(65536 / (1 + np.exp(np.arange(CLIP, -CLIP - 1, -1) / 256))).astype(np.int32)
_STRETCH = (np.searchsorted(SQUASH, np.arange(4096) * 16 + 8) - CLIP).astype(np.int32)


def new_tables(prior: tuple[Any, ...]) -> tuple[Any, Any]:
    """Return what adapts, as every stream starts with it.

    Counters [slots, 2] uint16, a chance in 1/65536 and how often it was seen; the mixer's weights [HEADS, 4, INPUTS].
    """
    return np.zeros((_SLOTS, 2), np.uint16), np.tile(prior[-1], (HEADS, 4, 1))


@inner
def quiet(labels, y, x):  # type: ignore[no-untyped-def]
    """Tell whether the pixels around (x, y) that come before it have one label."""
    label = labels[y, x - 1]
    for i in range(x - 2, x + 8):
        if labels[y - 1, i] != label:
            return False
    for i in range(x - 1, x + 4):
        if labels[y - 2, i] != label:
            return False
    return labels[y, x - 2] == label


@inner
def describe(labels, y, x, row):  # type: ignore[no-untyped-def]
    """Find the two candidates, and which of them each pixel of the template is."""
    first = labels[y, x - 1]
    second = -1
    for t in range(len(_DX)):
        label = labels[y + _DY[t], x + _DX[t]]
        if label == first:
            row[FEATURE + t] = 0
        elif second < 0 or label == second:
            second = label
            row[FEATURE + t] = 1
        else:
            row[FEATURE + t] = 2
    row[FIRST] = first
    row[SECOND] = second


def make_network(prior: tuple[Any, ...]) -> Any:
    """Return the network of these tables, compiled; they are constants of its loops, which as arguments slow them.

    Two layers of rectified sums of small integers give the first estimate of each decision, a logit in 1/256.
    """
    layer1, bias1, layer2, bias2, layer3, bias3, _ = prior
    num_hidden, num_latent = layer2.shape

    @inner
    def network(row):  # type: ignore[no-untyped-def]
        # lengths that a compiler cannot know: known loops it would write out, without vectors, at three times the time
        latent, hidden = row[UNITS : len(row) - num_hidden], row[UNITS + num_latent :]
        for j in range(len(hidden)):
            hidden[j] = bias1[j]
        for t in range(len(_DX)):
            kind = row[FEATURE + t]
            if kind > 0:
                weights = layer1[t, kind - 1]
                for j in range(len(hidden)):
                    hidden[j] += weights[j]
        for k in range(len(latent)):
            latent[k] = bias2[k]
        for j in range(num_hidden):
            value = min(hidden[j], 4095)
            if value > 0:
                weights = layer2[j]
                for k in range(len(latent)):
                    latent[k] += value * weights[k]
        for h in range(HEADS):
            total = bias3[h]
            for k in range(num_latent):
                total += min(max(latent[k] >> 6, 0), 4095) * layer3[k, h]
            row[INPUT + h * INPUTS] = min(max(total >> 4, -CLIP), CLIP)

    return network


network, network2 = map(make_network, map(load_prior, PRIORS))


@inner
def contexts(row):  # type: ignore[no-untyped-def]
    """Find the counters of a pixel: by its nearest 6, 11 and 16; and for the other decision all, by 4 and by 8."""
    bits = 0
    for t in range(1, 17):
        bits = bits << 1 | (row[FEATURE + t] > 0)
        if t == 6:
            row[SLOT] = _BASES[0, 0] + bits
        elif t == 11:
            row[SLOT + 1] = _BASES[0, 1] + bits
        elif t == 16:
            row[SLOT + 2] = _BASES[0, 2] + bits
    digits = 0
    for t in range(1, 9):
        digits = digits * 3 + row[FEATURE + t]
        if t == 4:
            row[SLOT + DECISION + 1] = _BASES[1, 1] + digits
        elif t == 8:
            row[SLOT + DECISION + 2] = _BASES[1, 2] + digits
    row[SLOT + DECISION] = _BASES[1, 0]


@inner
def mix(counters, weights, row, h):  # type: ignore[no-untyped-def]
    """Weigh the network and the counters into one chance."""
    inputs, slots = row[INPUT + h * INPUTS :], row[SLOT + h * DECISION :]
    seen: Any = 0
    for c in range(3):
        counter = counters[slots[c]]
        seen = counter[1]
        inputs[c + 1] = _STRETCH[counter[0] >> 4] if seen > 0 else inputs[0]
    chosen = 0 if seen == 0 else 1 if seen < 5 else 2 if seen < 12 else 3
    total: Any = np.int64(0)
    for k in range(INPUTS):
        total += np.int64(weights[h, chosen, k]) * inputs[k]
    logit: Any = min(max(total >> 16, -CLIP), CLIP)
    slots[CHOSEN] = chosen
    slots[MIXED] = min(max(SQUASH[logit + CLIP], _SURE), 65536 - _SURE)
    return slots[MIXED] / 65536


@inner
def learn(counters, weights, row, h, bit):  # type: ignore[no-untyped-def]
    """Move the weights along the error, and the counters to the bit."""
    inputs, slots = row[INPUT + h * INPUTS :], row[SLOT + h * DECISION :]
    error = (bit << 16) - slots[MIXED]
    chosen = weights[h, slots[CHOSEN]]
    for k in range(INPUTS):
        step = np.int64(inputs[k]) * error * _RATE
        weight = chosen[k] + ((step + (1 << (_SHIFT - 1))) >> _SHIFT)
        chosen[k] = min(max(weight, -_HEAVIEST), _HEAVIEST)
    for c in range(3):
        counter = counters[slots[c]]
        chance: Any = np.int64(counter[0])
        seen: Any = np.int64(counter[1])
        if seen == 0:
            chance = np.int64(SQUASH[inputs[0] + CLIP])
            seen = 2
        chance += ((bit << 16) - chance) * 2 // (2 * seen + 3)
        counter[0] = min(max(chance, 32), 65504)
        counter[1] = min(seen + 1, _MEMORY)
