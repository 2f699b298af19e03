"""The model of label maps: what a pixel may be, given the pixels before it. Loops in integers, compiled by numba.

All numbers are integers, ``>>`` and ``//`` round down, ``clip(v, m)`` is v kept within -m to m. Arrays named here are
those of `prior`; the stream that the bits stand in is specified in `labels`.

**Features.** The template lists pixels (dx, dy) before this one: those of row 0 from dx = -8 to -1, of row -1 from -8
to 7, -2: -7 to 8, -3: -6 to 7, -4: -5 to 6, -5: -3 to 4, -6: -2 to 3; by dx**2 + dy**2, then the nearest row first,
then from the left. The first one, (-1, 0), has the first candidate; the second candidate is the first other label in
the list. Feature f_t of place t, from 0, is 0, 1 or 2: the label is the first candidate, the second, or neither.

**Network.** With ``a_j = bias1_j`` plus ``layer1[t, f_t - 1, j]`` for all t with f_t > 0, kept within 0 to 4095, and
``b_k = (bias2_k + sum_j a_j * layer2[j, k]) >> 6``, kept within 0 to 4095, the logit of decision h, in 1/256, is ``x_0
= clip((bias3_h + sum_k b_k * layer3[k, h]) >> 4, 3071)``. Decision 0 is whether the pixel has the second candidate
rather than the first, decision 1 whether it has neither.

**Counters.** A decision looks at three of them, in tables of its own: decision 0 at those of which of f_1 to f_6, of
f_1 to f_11, of f_1 to f_16 are not 0; decision 1 at a single one, and at those of the values f_1 to f_4, and f_1 to
f_8. A counter has a chance c, in 1/65536, and an age n, 0 at first. Its logit x_i, i from 1 to 3, is ``stretch(c >>
4)``, and x_0 while n is 0. With ``squash(x)`` the whole number nearest to 65536 / (1 + e**(-x / 256)), ``stretch(q)``
is the least x from -3071 on with squash(x) at least 16 q + 8.

**Chance.** Each decision has four sets of weights w_0 to w_3, all ``mixer`` at first; its third counter chooses: n = 0,
below 5, below 12, or more. The chance of a 1, in 1/65536, is ``p = squash(clip(sum_i w_i * x_i >> 16, 3071))``, kept
within 16 to 65520.

**Learning.** Counters and weights change after a wave's last bit, pixel by pixel in the wave's order, decision 1, if
there is one, before decision 0; with the x_i, the p and the set of weights that the bit v was coded with. With ``e =
65536 v - p`` each weight of the set becomes ``clip(w_i + ((6 * x_i * e + 2**17) >> 18), 2**22)``. Then each of the
three counters: if its age is 0, it takes c = squash(x_0) and n = 2; then ``c += 2 * (65536 v - c) // (2 n + 3)``, kept
within 32 to 65504, and n grows by 1, to 40 at most.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numba import njit

from kcgs.kernels.compiled import compile_kept, count_compiled, say

from .prior import HIDDEN, LATENT, TEMPLATE, load_prior

T = TypeVar("T")

LEFT, RIGHT, TOP = 8, 9, 6  # margins around the map
CLIP = 3071  # largest logit, in 1/256
HEADS, INPUTS = 2, 4  # decisions: which of two candidates, or neither; estimates that are mixed
# columns of a pixel's row: its place, the candidates, whether it is decided by bits, its label; then for each decision
# the estimates, and the three counters, the mixer's weights, the chance; then the template, and the network's units
X, Y, FIRST, SECOND, CODED, LABEL, INPUT = 0, 1, 2, 3, 4, 5, 6
SLOT = INPUT + HEADS * INPUTS
CHOSEN, MIXED, DECISION = 3, 4, 5
FEATURE = SLOT + HEADS * DECISION
_LATENT = FEATURE + len(TEMPLATE)
_HIDDEN = _LATENT + LATENT
COLUMNS = _HIDDEN + HIDDEN

# where the counters of each context begin
_BASES = np.array([[0, 1 << 6, (1 << 6) + (1 << 11)], [67648, 67649, 67649 + 3**4]], np.int32)
_SLOTS = 67649 + 3**4 + 3**8
_RATE, _SHIFT = 6, 18  # the mixer's step
_HEAVIEST = 1 << 22
_MEMORY = 40  # decisions that a counter remembers
_SURE = 16  # least chance, in 1/65536


# constants of the loops: the template, the network, 65536 / (1 + e**(-x / 256)) for logits from -CLIP, its inverse.
# No value of the third but 32768 is within 1e-6 of a half before it is rounded: any machine's exp gives the same table.
_DX, _DY = (np.array(axis, np.int32) for axis in zip(*TEMPLATE, strict=True))
_LAYER1, _BIAS1, _LAYER2, _BIAS2, _LAYER3, _BIAS3, _MIXER = load_prior()
SQUASH = np.rint(65536 / (1 + np.exp(np.arange(CLIP, -CLIP - 1, -1) / 256))).astype(np.int32)
_STRETCH = (np.searchsorted(SQUASH, np.arange(4096) * 16 + 8) - CLIP).astype(np.int32)


class Tables(NamedTuple):
    """What adapts."""

    counters: Any  # [slots, 2] uint16: the chance in 1/65536, how often it was seen
    weights: Any  # [HEADS, 4, INPUTS] int32, 1/65536


def new_tables() -> Tables:
    """Return what every stream starts with."""
    weights = np.empty((HEADS, 4, INPUTS), np.int32)
    weights[:] = _MIXER
    return Tables(np.zeros((_SLOTS, 2), np.uint16), weights)


inner = cast(Any, njit)(no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")


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


@inner
def network(row):  # type: ignore[no-untyped-def]
    """Two layers of rectified sums of small integers; the first estimate of each decision, a logit in 1/256."""
    # lengths that a compiler cannot know: it would write known loops out, and not use vectors, at three times the time
    latent, hidden = row[_LATENT : len(row) - HIDDEN], row[_HIDDEN:]
    for j in range(len(hidden)):
        hidden[j] = _BIAS1[j]
    for t in range(len(_DX)):
        kind = row[FEATURE + t]
        if kind > 0:
            weights = _LAYER1[t, kind - 1]
            for j in range(len(hidden)):
                hidden[j] += weights[j]
    for k in range(len(latent)):
        latent[k] = _BIAS2[k]
    for j in range(HIDDEN):
        value = min(hidden[j], 4095)
        if value > 0:
            weights = _LAYER2[j]
            for k in range(len(latent)):
                latent[k] += value * weights[k]
    for h in range(HEADS):
        total = _BIAS3[h]
        for k in range(LATENT):
            total += min(max(latent[k] >> 6, 0), 4095) * _LAYER3[k, h]
        row[INPUT + h * INPUTS] = min(max(total >> 4, -CLIP), CLIP)


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
def mix(tables, row, h):  # type: ignore[no-untyped-def]
    """Weigh the network and the counters into one chance."""
    inputs, slots = row[INPUT + h * INPUTS :], row[SLOT + h * DECISION :]
    seen: Any = 0
    for c in range(3):
        counter = tables.counters[slots[c]]
        seen = counter[1]
        inputs[c + 1] = _STRETCH[counter[0] >> 4] if seen > 0 else inputs[0]
    chosen = 0 if seen == 0 else 1 if seen < 5 else 2 if seen < 12 else 3
    total: Any = np.int64(0)
    for k in range(INPUTS):
        total += np.int64(tables.weights[h, chosen, k]) * inputs[k]
    logit: Any = min(max(total >> 16, -CLIP), CLIP)
    slots[CHOSEN] = chosen
    slots[MIXED] = min(max(SQUASH[logit + CLIP], _SURE), 65536 - _SURE)
    return slots[MIXED] / 65536


@inner
def learn(tables, row, h, bit):  # type: ignore[no-untyped-def]
    """Move the weights along the error, and the counters to the bit."""
    inputs, slots = row[INPUT + h * INPUTS :], row[SLOT + h * DECISION :]
    error = (bit << 16) - slots[MIXED]
    weights = tables.weights[h, slots[CHOSEN]]
    for k in range(INPUTS):
        step = np.int64(inputs[k]) * error * _RATE
        weight = weights[k] + ((step + (1 << (_SHIFT - 1))) >> _SHIFT)
        weights[k] = min(max(weight, -_HEAVIEST), _HEAVIEST)
    for c in range(3):
        counter = tables.counters[slots[c]]
        chance: Any = np.int64(counter[0])
        seen: Any = np.int64(counter[1])
        if seen == 0:
            chance = np.int64(SQUASH[inputs[0] + CLIP])
            seen = 2
        chance += ((bit << 16) - chance) * 2 // (2 * seen + 3)
        counter[0] = min(max(chance, 32), 65504)
        counter[1] = min(seen + 1, _MEMORY)


def compiled(name: str, compiler: Callable[[str, bool], T], rehearse: Callable[[T], None], *sources: str) -> T:
    """Compile loops that call those of this file, kept on disk by what is in the sources; say how long it took.

    Args:
        name: of what they do.
        compiler: makes them of a fingerprint, and of whether to keep them on disk.
        rehearse: calls each of them once, for it is then that they compile.
        sources: files that they are in, besides this one.
    """
    start, folder = time.perf_counter(), Path(__file__).parent
    kept = [folder / source for source in ("contexts.py", "prior.py", "prior.bin", *sources)]
    loops = compile_kept("codec", compiler, kept)
    rehearse(loops)
    say(name, start, count_compiled(loops) > 0, loops)
    return loops
