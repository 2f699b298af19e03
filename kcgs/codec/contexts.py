"""The model of label maps: what a pixel may be, given the pixels before it. Loops in integers, compiled by numba.

Everything that a decoder must reproduce is here and in `prior`; the stream itself is specified in `labels`.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numba import njit

from .prior import HIDDEN, LATENT, TEMPLATE, Prior, load_prior

log = logging.getLogger("kcgs")

LEFT, RIGHT, TOP = 8, 9, 6  # margins around the map
CLIP = 3071  # largest logit, in 1/256
HEADS, INPUTS = 2, 4  # decisions: which of two candidates, or neither; estimates that are mixed
# columns of a pixel's row: its place, the candidates, whether it is decided by bits, its label
X, Y, FIRST, SECOND, CODED, LABEL, COLUMNS = 0, 1, 2, 3, 4, 5, 6

# where the counters of each context begin
_BASES = np.array([[0, 1 << 6, (1 << 6) + (1 << 11)], [67648, 67649, 67649 + 3**4]], np.int32)
_SLOTS = 67649 + 3**4 + 3**8
_RATE, _SHIFT = 6, 18  # the mixer's step
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
def describe(labels, y, x, dx, dy, row, feature):  # type: ignore[no-untyped-def]
    """Find the two candidates, and which of them each pixel of the template is."""
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


@inner
def network(feature, prior, out):  # type: ignore[no-untyped-def]
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


@inner
def contexts(feature, bases, slots):  # type: ignore[no-untyped-def]
    """Find the counters of a pixel: by its nearest 6, 11 and 16; and for the other decision all, by 4 and by 8."""
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


@inner
def mix(tables, work, i, h):  # type: ignore[no-untyped-def]
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


@inner
def learn(tables, work, i, h, bit):  # type: ignore[no-untyped-def]
    """Move the weights along the error, and the counters to the bit."""
    error = (bit << 16) - work.mixed[i, h]
    weights = tables.weights[h, work.chosen[i, h]]
    for k in range(INPUTS):
        step = np.int64(work.inputs[i, h, k]) * error * _RATE
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


def compiled(compiler: Callable[[str, bool], Any], *sources: str) -> Any:
    """Compile loops that call those of this file, kept on disk by what is in the sources."""
    digest = hashlib.sha256()
    for name in ("contexts.py", "prior.py", *sources):
        digest.update((Path(__file__).parent / name).read_bytes())
    try:
        return compiler(digest.hexdigest(), True)
    except RuntimeError:  # numba finds no folder that it may write to
        log.warning("kcgs: no folder to keep the compiled codec in; set NUMBA_CACHE_DIR to one")
        return compiler(digest.hexdigest(), False)
