"""What is likely: adaptive tables of weights for the numbers of a Gaussian.

All numbers are float64; every sum goes from left to right, every operation is rounded once.

**A categorical symbol** of A values with weights w_0 to w_(A-1), above 0, is coded in 24 bits: with
``scale = (2**24 - A) / (w_0 + ... + w_(A-1))`` the codes of value s begin at
``floor((w_0 + ... + w_(s-1)) * scale) + s``, and end where those of s + 1 begin, or at 2**24. (That is constriction's
Categorical with ``perfect=False``.) In a *Uniform* of n, 2 to 2**24, those of s begin at ``s * (2**24 // n)``, and the
last ones end at 2**24; for n = 1 nothing is coded.

**Choices** code a symbol by weights that they keep, for each of their contexts; after a group of symbols that are coded
together, 1 is added to the weight of each that was seen.

**Magnitudes** code sizes 0, 1, 2 ... below 2**24 in units of a given scale t. They keep, for each of their contexts, a
*shape* of 24 bins: bin i is about sizes from i t / 8 to (i + 1) t / 8. A size is its *bucket* (0 to 15 have their own;
each octave from 2**4 to 2**23 has eight of equal width: 176 in all), as a categorical symbol, then a Uniform of the
bucket's width. Of a group all buckets come first, then all Uniforms. The weight of the bucket [a, b) is

    F(b - 1/2) - F(max(a - 1/2, 0)) + 0.001 * total / 176,

where F rises from 0 to ``total``, the sum of the shape's bins, piecewise linear with knots at the bins' borders e_i =
i * (t * 0.125) and constant beyond: ``F(x) = F_i + clip((x - e_i) / (e_(i+1) - e_i), 0, 1) * (F_(i+1) - F_i)``, i
being the last border at or below x, at most 23. After a group each size s is spread over [max(s - 1/2, 0), s + 1/2]:
each bin of its context (the last one without end) gets the share that it covers, rounded to whole 1/256 (halves up);
the group's sum is added to the shape at once.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from .exact import Floats
from .rangecoder import Coder, batches

Integers = NDArray[np.int64]

# sizes below 16 have a bucket each; above, an octave has eight
_PLAIN, _AN_OCTAVE = 16, 8
_OCTAVES = (4, 24)
_BUCKETS = _PLAIN + (_OCTAVES[1] - _OCTAVES[0]) * _AN_OCTAVE
# bins of the shape that all scales share, in units of the scale
_BINS, _WIDTH = 24, 0.125
_PARTS = 256


def _bounds() -> tuple[Integers, Integers]:
    starts = list(range(_PLAIN))
    for octave in range(*_OCTAVES):
        starts += [(1 << octave) + ((1 << octave) // _AN_OCTAVE) * i for i in range(_AN_OCTAVE)]
    low = np.array(starts, np.int64)
    return low, np.append(low[1:], 1 << _OCTAVES[1])


_LOW, _HIGH = _bounds()
_MIDDLES = np.maximum(np.append(_LOW, _HIGH[-1]) - 0.5, 0.0)  # between the sizes about each bound


class Magnitudes:
    """Adaptive model of sizes 0, 1, 2 ... whose scale is known: a shape over size / scale, learned for all scales.

    Args:
        prior: weights of the `_BINS` bins of size / scale to start from.
        contexts: how many kinds there are, each of which learns by itself.
    """

    def __init__(self, prior: Floats, contexts: int = 1) -> None:
        self._shape = np.tile(prior[:, None], (1, contexts)).T.copy()  # [contexts, bins]

    def code(self, coder: Coder, scale: float, context: Integers, sizes: Integers | None) -> Integers:
        """Code one size for each context [n]; `scale` is what size is measured in, above 0."""
        tables = self._tables(scale)
        bucket = None if sizes is None else np.searchsorted(_LOW, sizes, side="right") - 1
        bucket = coder.choose(tables, context, bucket)
        width = _HIGH[bucket] - _LOW[bucket]
        found = _LOW[bucket] + coder.uniform(width, None if sizes is None else sizes - _LOW[bucket])
        self._learn(scale, context, found)
        return found

    def _learn(self, scale: float, context: Integers, sizes: Integers) -> None:
        # a size stands for what rounds to it; in whole parts, whose sums no order changes: equal ones at once
        edges = np.arange(_BINS + 1) * (scale * _WIDTH)
        edges[-1] = np.inf
        contexts = len(self._shape)
        kinds, counts = np.unique(sizes * contexts + context, return_counts=True)
        learned = np.zeros(self._shape.shape)
        for part in batches(len(kinds)):
            size, row = np.divmod(kinds[part], contexts)
            low, high = np.maximum(size - 0.5, 0.0)[:, None], (size + 0.5)[:, None]
            overlap = np.maximum(np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1]), 0.0) / (high - low)
            share = np.floor(overlap * _PARTS + 0.5) * counts[part, None]
            at = row[:, None] * _BINS + np.arange(_BINS)
            learned += np.bincount(at.ravel(), share.ravel(), learned.size).reshape(learned.shape)
        self._shape += learned / _PARTS

    def _tables(self, scale: float) -> Floats:
        # the share of each bucket: the integral of the shape between its bounds, by linear interpolation; its sums by
        # hand, since numpy's have an order of their own
        total = np.array([list(itertools.accumulate(shape, initial=0.0)) for shape in self._shape.tolist()])
        edges: Floats = np.arange(_BINS + 1.0) * (scale * _WIDTH)
        cumulative = _interpolate(_MIDDLES, edges, total)
        return (cumulative[:, 1:] - cumulative[:, :-1]) + 1e-3 * total[:, -1:] / _BUCKETS


class Choices:
    """Adaptive model of a few symbols."""

    def __init__(self, start: Floats, contexts: int = 1) -> None:
        self._weights = np.tile(start[:, None], (1, contexts)).T.copy()

    def code(self, coder: Coder, context: Integers, values: Integers | None) -> Integers:
        """Code one symbol for each context [n]."""
        found = coder.choose(self._weights, context, values)
        np.add.at(self._weights, (context, found), 1.0)
        return found


def _interpolate(x: Floats, edges: Floats, heights: Floats) -> Floats:
    # numpy's own interpolation may order its operations otherwise; x is at or above the first edge
    at = np.minimum(np.searchsorted(edges, x, side="right") - 1, len(edges) - 2)
    share = np.minimum((x - edges[at]) / (edges[at + 1] - edges[at]), 1.0)
    low = heights.take(at, 1)
    found: Floats = low + share * (heights.take(at + 1, 1) - low)
    return found
