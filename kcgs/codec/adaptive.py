"""Adaptive models: tables of what is likely, which learn from each symbol as it is coded (docs/format.md).

All numbers are float64; every sum goes from left to right, every operation is rounded once.
"""

from __future__ import annotations

import itertools

import numpy as np

from .exact import Floats, Integers
from .rangecoder import ONE, Coder

_LEAST = 64  # chance of an adaptive bit, in 1 / ONE
# magnitudes below 16 have a bucket each; above, an octave has eight
_PLAIN, _PER_OCTAVE = 16, 8
_OCTAVES = (4, 24)
_BUCKETS = _PLAIN + (_OCTAVES[1] - _OCTAVES[0]) * _PER_OCTAVE
_EIGHTHS = [(1 << octave - 3) * eighth for octave in range(*_OCTAVES) for eighth in range(_PER_OCTAVE, 2 * _PER_OCTAVE)]
_LOW = np.array([*range(_PLAIN), *_EIGHTHS], np.int64)
_HIGH = np.append(_LOW[1:], 1 << _OCTAVES[1])
_MIDDLES = np.maximum(np.append(_LOW, _HIGH[-1]) - 0.5, 0.0)  # between the magnitudes about each bound
# bins of the shape that all scales share, in units of the scale
_BINS, _WIDTH = 24, 0.125
_PARTS = 256
# magnitudes that are learned from together, so that their tables fit into memory
_TOGETHER = 1 << 12


class AdaptiveBit:
    """A bit whose chance is learned, even at first."""

    def __init__(self) -> None:
        self._ones, self._all = 2, 4

    def code(self, coder: Coder, value: bool) -> bool:
        """Code the bit."""
        chance = min(max(self._ones * ONE // self._all, _LEAST), ONE - _LEAST)
        bit = bool(coder.bits(np.array([chance / ONE]), np.array([value], np.int32))[0])
        self._ones += 2 * bit
        self._all += 2
        return bit


class AdaptiveSymbol:
    """One of a few symbols, with the weights that they have at first."""

    def __init__(self, weights: Floats) -> None:
        self._weights = weights.copy()

    def code(self, coder: Coder, count: int, values: Integers | None) -> Integers:
        """Code `count` symbols."""
        found = coder.repeat(self._weights, count, values)
        np.add.at(self._weights, found, 1.0)
        return found


class AdaptiveNumber:
    """A number whose count of bits is learned, with the weights of 0 bits, 1, 2 and so on, at first."""

    def __init__(self, weights: Floats) -> None:
        self._length = AdaptiveSymbol(weights)

    def code(self, coder: Coder, value: int | None) -> int:
        """Code the number: its count of bits, then what is below its highest bit."""
        length = int(self._length.code(coder, 1, None if value is None else np.array([value.bit_length()]))[0])
        highest = 1 << (length - 1) if length else 0
        rest = None if value is None else np.array([value - highest])
        return highest + int(coder.uniform(np.array([max(highest, 1)]), rest)[0])


class AdaptiveMagnitude:
    """Magnitudes 0, 1, 2 ... whose scale is known: a shape over magnitude / scale, learned for all scales.

    `shape` has the weights of the `_BINS` bins at first; each of the contexts learns by itself.
    """

    def __init__(self, shape: Floats, contexts: int = 1) -> None:
        self._shape = np.tile(shape[:, None], (1, contexts)).T.copy()  # [contexts, bins]

    def code(self, coder: Coder, scale: float, context: Integers, values: Integers | None) -> Integers:
        """Code one magnitude for each context [n]; `scale` is what it is measured in, above 0."""
        tables = self._tables(scale)
        bucket = None if values is None else np.searchsorted(_LOW, values, side="right") - 1
        bucket = coder.choose(tables, context, bucket)
        width = _HIGH[bucket] - _LOW[bucket]
        found = _LOW[bucket] + coder.uniform(width, None if values is None else values - _LOW[bucket])
        self._learn(scale, context, found)
        return found

    def _learn(self, scale: float, context: Integers, values: Integers) -> None:
        # a magnitude stands for what rounds to it; in whole parts, whose sums no order changes: equal ones at once
        edges = np.arange(_BINS + 1) * (scale * _WIDTH)
        edges[-1] = np.inf
        contexts = len(self._shape)
        kinds, counts = np.unique(values * contexts + context, return_counts=True)
        learned = np.zeros(self._shape.shape)
        for start in range(0, len(kinds), _TOGETHER):
            part = slice(start, start + _TOGETHER)
            value, row = np.divmod(kinds[part], contexts)
            low, high = np.maximum(value - 0.5, 0.0)[:, None], (value + 0.5)[:, None]
            overlap = np.maximum(np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1]), 0.0) / (high - low)
            share = np.floor(overlap * _PARTS + 0.5) * counts[part, None]
            cell = row[:, None] * _BINS + np.arange(_BINS)
            learned += np.bincount(cell.ravel(), share.ravel(), learned.size).reshape(learned.shape)
        self._shape += learned / _PARTS

    def _tables(self, scale: float) -> Floats:
        # the share of each bucket: the integral of the shape between its bounds, by linear interpolation; its sums by
        # hand, since numpy's have an order of their own
        total = np.array([list(itertools.accumulate(shape, initial=0.0)) for shape in self._shape.tolist()])
        edges: Floats = np.arange(_BINS + 1.0) * (scale * _WIDTH)
        # numpy's own interpolation may order its operations otherwise
        index = np.minimum(np.searchsorted(edges, _MIDDLES, side="right") - 1, _BINS - 1)
        share = np.minimum((_MIDDLES - edges[index]) / (edges[index + 1] - edges[index]), 1.0)
        low = total.take(index, 1)
        cumulative: Floats = low + share * (total.take(index + 1, 1) - low)
        tables: Floats = (cumulative[:, 1:] - cumulative[:, :-1]) + 1e-3 * total[:, -1:] / _BUCKETS
        return tables
