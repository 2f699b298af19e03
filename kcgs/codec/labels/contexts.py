"""The context model of label maps: the chances of a pixel's label, given the pixels before it (docs/format.md).

A small network, trained once by `models/label_prior.py`, gives the first estimate. Counters that learn from the
map correct it. All loops compute with integers and are compiled by numba: ``>>`` and ``//`` round down.
"""

from __future__ import annotations

from importlib import resources
from typing import Any

import numpy as np

from kcgs.compiled.program import inner

# dx of the first and the last pixel of the template in each row; the pixel's own row comes first, then the rows above
_SPANS = ((-8, -1), (-8, 7), (-7, 8), (-6, 7), (-5, 6), (-3, 4), (-2, 3))
_OFFSETS = [(dx, -dy) for dy, (first, last) in enumerate(_SPANS) for dx in range(first, last + 1)]
TEMPLATE = sorted(_OFFSETS, key=lambda offset: (offset[0] ** 2 + offset[1] ** 2, -offset[1], offset[0]))
# units of the two hidden layers of each network: for maps in scenes, and for files of maps
PRIORS = {"scene_prior.bin": (48, 16), "map_file_prior.bin": (96, 32)}

LEFT = 8  # columns of the margin at the left of a map, in labels
RIGHT = 9  # columns of the margin at its right
TOP = 6  # rows of the margin above it
DECISIONS = 2  # 0: second candidate rather than the first; 1: neither candidate
COUNTERS = 3  # counters per decision
ESTIMATES = 1 + COUNTERS  # logits that are mixed: of the network, then of the counters
PIXEL = np.dtype(
    [
        ("x", np.int32),  # column, margin included
        ("y", np.int32),  # row, margin included
        ("is_coded", np.int32),  # 1: bits decide between the candidates; 0: a seed
        ("first", np.int32),  # candidate
        ("second", np.int32),  # candidate
        ("label", np.int32),
        ("features", np.int32, len(TEMPLATE)),  # label of a neighbour: 0: first candidate, 1: second, 2: neither
        ("estimates", np.int32, (DECISIONS, ESTIMATES)),  # logits, in 1/256
        ("counters", np.int32, (DECISIONS, COUNTERS)),  # rows in the table of counters
        ("weights", np.int32, DECISIONS),  # index of the set of the mixer's weights
        ("chance", np.int32, DECISIONS),  # chance of a 1, in 1/65536
    ]
)

MAX_LOGIT = 3071  # in 1/256
_MAX_UNIT = 4095  # largest activation of a hidden unit, in 1/64
# number of contexts of each counter: decision 0 reads 2 values of 6, 11 and 16 features, decision 1 reads 3 values of
# 0, 4 and 8 features
_CONTEXT_SIZES = (2**6, 2**11, 2**16, 3**0, 3**4, 3**8)
_BASES = np.cumsum((0, *_CONTEXT_SIZES[:-1])).reshape(DECISIONS, COUNTERS).astype(np.int32)
_MIXER_RATE = 6  # learning rate of the mixer, before _MIXER_SHIFT
_MIXER_SHIFT = 18  # bits
_MAX_WEIGHT = 1 << 22  # largest weight of the mixer, in 1/65536
_WEIGHT_SETS = 4  # by the age of a decision's third counter: 0, below _YOUNG, below _OLD, or more
_YOUNG = 5  # bits
_OLD = 12  # bits
_MAX_AGE = 40  # bits that a counter remembers
_MIN_COUNTER = 32  # least chance of a counter, in 1/65536
_MIN_CHANCE = 16  # least chance of a bit, in 1/65536


def layout(hidden: int, latent: int) -> list[tuple[str, tuple[int, ...]]]:
    """Return type and shape of each table: weights and biases of three layers, then the mixer's first weights."""
    weights = ("<i1", (len(TEMPLATE), 2, hidden)), ("<i1", (hidden, latent)), ("<i1", (latent, DECISIONS))
    biases = ("<i2", (hidden,)), ("<i4", (latent,)), ("<i4", (DECISIONS,))
    return [table for layer in zip(weights, biases, strict=True) for table in layer] + [("<i4", (ESTIMATES,))]


def load_prior(name: str) -> tuple[Any, ...]:
    """Read the package's tables of a network, as int32, in the order of `layout`."""
    data = resources.files(__package__).joinpath(name).read_bytes()
    tables = np.frombuffer(data, [("", kind, shape) for kind, shape in layout(*PRIORS[name])])[0]
    return tuple(table.astype(np.int32) for table in tables)


def new_counters() -> Any:
    """Return the counters at the start of a stream, (counters, 2) uint16: a chance in 1/65536, and an age in bits."""
    return np.zeros((sum(_CONTEXT_SIZES), 2), np.uint16)


def new_mixer(prior: tuple[Any, ...]) -> Any:
    """Return the mixer's weights at the start of a stream, (decisions, sets, estimates) int32 in 1/65536."""
    return np.tile(prior[-1], (DECISIONS, _WEIGHT_SETS, 1))


# Constants of the loops. Before rounding, only the middle value of SQUASH is within 1e-6 of a half, so that any
# machine's exp gives the same table.
_DX = np.array([dx for dx, _ in TEMPLATE], np.int32)
_DY = np.array([dy for _, dy in TEMPLATE], np.int32)
SQUASH = np.rint(65536 / (1 + np.exp(np.arange(MAX_LOGIT, -MAX_LOGIT - 1, -1) / 256))).astype(np.int32)
_STRETCH = (np.searchsorted(SQUASH, np.arange(4096) * 16 + 8) - MAX_LOGIT).astype(np.int32)


@inner
def is_quiet(labels, y, x):
    """True if the neighbours of (x, y) that come before it have one label."""
    label = labels[y, x - 1]
    for i in range(x - 2, x + 8):
        if labels[y - 1, i] != label:
            return False
    for i in range(x - 1, x + 4):
        if labels[y - 2, i] != label:
            return False
    return labels[y, x - 2] == label


@inner
def find_features(labels, pixel):
    """Fill in the candidates of a pixel and its features."""
    y, x, features = pixel.y, pixel.x, pixel.features
    first = labels[y, x - 1]
    second = -1
    for t in range(len(_DX)):
        label = labels[y + _DY[t], x + _DX[t]]
        if label == first:
            features[t] = 0
        elif second < 0 or label == second:
            second = label
            features[t] = 1
        else:
            features[t] = 2
    pixel.first = first
    pixel.second = second


def make_network(prior: tuple[Any, ...]) -> Any:
    """Compile a network: two hidden layers with rectified sums give the first estimate of each decision.

    The network's tables are constants of its loops: as arguments they would slow the loops down.
    """
    layer1, bias1, layer2, bias2, layer3, bias3, _ = prior
    num_hidden, num_latent = layer2.shape

    @inner
    def network(pixel, units):
        # the compiler must not know these lengths: it would unroll the loops, without vectors, 3 times slower
        latent, hidden = units[: len(units) - num_hidden], units[num_latent:]
        features, estimates = pixel.features, pixel.estimates
        for j in range(len(hidden)):
            hidden[j] = bias1[j]
        for t in range(len(_DX)):
            feature = features[t]
            if feature > 0:
                weights = layer1[t, feature - 1]
                for j in range(len(hidden)):
                    hidden[j] += weights[j]
        for k in range(len(latent)):
            latent[k] = bias2[k]
        for j in range(num_hidden):
            unit = min(hidden[j], _MAX_UNIT)
            if unit > 0:
                weights = layer2[j]
                for k in range(len(latent)):
                    latent[k] += unit * weights[k]
        for decision in range(DECISIONS):
            total = bias3[decision]
            for k in range(num_latent):
                total += min(max(latent[k] >> 6, 0), _MAX_UNIT) * layer3[k, decision]
            estimates[decision, 0] = min(max(total >> 4, -MAX_LOGIT), MAX_LOGIT)

    return network


scene_network = make_network(load_prior("scene_prior.bin"))
file_network = make_network(load_prior("map_file_prior.bin"))


@inner
def find_counters(pixel):
    """Fill in the counters of a pixel: its features select the contexts."""
    features, counters = pixel.features, pixel.counters
    bits = 0
    for t in range(1, 17):
        bits = bits << 1 | (features[t] > 0)
        if t == 6:
            counters[0, 0] = _BASES[0, 0] + bits
        elif t == 11:
            counters[0, 1] = _BASES[0, 1] + bits
        elif t == 16:
            counters[0, 2] = _BASES[0, 2] + bits
    counters[1, 0] = _BASES[1, 0]
    digits = 0
    for t in range(1, 9):
        digits = digits * 3 + features[t]
        if t == 4:
            counters[1, 1] = _BASES[1, 1] + digits
        elif t == 8:
            counters[1, 2] = _BASES[1, 2] + digits


@inner
def mix(counters, mixer, pixel, decision):
    """Mix the estimates of the network and of the counters; return the chance of a 1."""
    estimates, rows = pixel.estimates[decision], pixel.counters[decision]
    age: Any = 0
    for c in range(COUNTERS):
        counter = counters[rows[c]]
        age = counter[1]
        estimates[c + 1] = _STRETCH[counter[0] >> 4] if age > 0 else estimates[0]
    weights = 0 if age == 0 else 1 if age < _YOUNG else 2 if age < _OLD else 3
    total: Any = np.int64(0)
    for k in range(ESTIMATES):
        total += np.int64(mixer[decision, weights, k]) * estimates[k]
    logit: Any = min(max(total >> 16, -MAX_LOGIT), MAX_LOGIT)
    chance = min(max(SQUASH[logit + MAX_LOGIT], _MIN_CHANCE), 65536 - _MIN_CHANCE)
    pixel.weights[decision] = weights
    pixel.chance[decision] = chance
    return chance / 65536


@inner
def learn(counters, mixer, pixel, decision, bit):
    """Move the mixer's weights along the error, and the counters towards the bit."""
    estimates, rows = pixel.estimates[decision], pixel.counters[decision]
    error = (bit << 16) - pixel.chance[decision]
    weights = mixer[decision, pixel.weights[decision]]
    for k in range(ESTIMATES):
        step = np.int64(estimates[k]) * error * _MIXER_RATE
        weight = weights[k] + ((step + (1 << (_MIXER_SHIFT - 1))) >> _MIXER_SHIFT)
        weights[k] = min(max(weight, -_MAX_WEIGHT), _MAX_WEIGHT)
    for c in range(COUNTERS):
        counter = counters[rows[c]]
        chance: Any = np.int64(counter[0])
        age: Any = np.int64(counter[1])
        if age == 0:
            chance = np.int64(SQUASH[estimates[0] + MAX_LOGIT])
            age = 2
        chance += ((bit << 16) - chance) * 2 // (2 * age + 3)
        counter[0] = min(max(chance, _MIN_COUNTER), 65536 - _MIN_COUNTER)
        counter[1] = min(age + 1, _MAX_AGE)
