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
_TURN = 16  # bins of half a turn
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
    """Magnitudes 0, 1, 2 ... whose scales are known: a shape over magnitude / scale, learned for all scales.

    `shapes` [contexts, bins] has the weights of the `_BINS` bins at first; each of the contexts learns by itself.
    """

    def __init__(self, shapes: Floats) -> None:
        self._shapes = shapes.copy()

    def code(
        self, coder: Coder, scales: Floats, level: Integers, context: Integers, values: Integers | None
    ) -> Integers:
        """Code one magnitude for each context [n]; `level` [n] says by which of the scales, above 0, it is measured."""
        present, level = np.unique(level, return_inverse=True)
        measures = scales[present].tolist()
        tables = np.concatenate([self._tables(scale) for scale in measures])
        bucket = None if values is None else np.searchsorted(_LOW, values, side="right") - 1
        bucket = coder.choose(tables, level * len(self._shapes) + context, bucket)
        width = _HIGH[bucket] - _LOW[bucket]
        found = _LOW[bucket] + coder.uniform(width, None if values is None else values - _LOW[bucket])
        learned = np.zeros(self._shapes.shape)
        for i, scale in enumerate(measures):
            these = level == i
            learned += self._parts(scale, context[these], found[these])
        self._shapes += learned / _PARTS
        return found

    def _parts(self, scale: float, context: Integers, values: Integers) -> Floats:
        # a magnitude stands for what rounds to it; in whole parts, whose sums no order changes: equal ones at once
        edges = np.arange(_BINS + 1) * (scale * _WIDTH)
        edges[-1] = np.inf
        contexts = len(self._shapes)
        kinds, counts = np.unique(values * contexts + context, return_counts=True)
        learned = np.zeros(self._shapes.shape)
        for start in range(0, len(kinds), _TOGETHER):
            part = slice(start, start + _TOGETHER)
            value, row = np.divmod(kinds[part], contexts)
            low, high = np.maximum(value - 0.5, 0.0)[:, None], (value + 0.5)[:, None]
            overlap = np.maximum(np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1]), 0.0) / (high - low)
            share = np.floor(overlap * _PARTS + 0.5) * counts[part, None]
            cell = row[:, None] * _BINS + np.arange(_BINS)
            learned += np.bincount(cell.ravel(), share.ravel(), learned.size).reshape(learned.shape)
        return learned

    def _tables(self, scale: float) -> Floats:
        # the share of each bucket: the integral of the shape between its bounds, by linear interpolation; its sums by
        # hand, since numpy's have an order of their own
        total = np.array([list(itertools.accumulate(shape, initial=0.0)) for shape in self._shapes.tolist()])
        edges: Floats = np.arange(_BINS + 1.0) * (scale * _WIDTH)
        # numpy's own interpolation may order its operations otherwise
        index = np.minimum(np.searchsorted(edges, _MIDDLES, side="right") - 1, _BINS - 1)
        share = np.minimum((_MIDDLES - edges[index]) / (edges[index + 1] - edges[index]), 1.0)
        low = total.take(index, 1)
        cumulative: Floats = low + share * (total.take(index + 1, 1) - low)
        tables: Floats = (cumulative[:, 1:] - cumulative[:, :-1]) + 1e-3 * total[:, -1:] / _BUCKETS
        return tables


class AdaptiveAngle:
    """Angles, each one of so many in half a turn; with the weights of bins about 0, 1/16, 2/16 ... at first."""

    def __init__(self, weights: Floats) -> None:
        self._weights = weights.copy()

    def code(self, coder: Coder, turns: Integers, values: Integers | None) -> Integers:
        """Code one of 0 to `turns` - 1 each, (n,); bins know nothing of fewer angles than there are bins."""
        many = turns >= _TURN
        shift, sizes = np.where(many, turns // (2 * _TURN), 0), np.where(many, 1, turns)
        turned = None if values is None else (values + shift) % turns
        kinds, row = np.unique(turns[many], return_inverse=True)
        borders = np.arange(_TURN + 1) * kinds[:, None] // _TURN
        known = None
        if turned is not None:
            known = (borders[row, 1:] <= turned[many, None]).sum(1)
        bins = coder.choose(self._weights * np.diff(borders), row, known) if len(row) else np.zeros(0, np.int64)
        low = np.zeros(len(turns), np.int64)
        low[many] = borders[row, bins]
        sizes[many] = borders[row, bins + 1] - low[many]
        found = low + coder.uniform(sizes, None if turned is None else turned - low)
        np.add.at(self._weights, bins, 1.0)
        return (found - shift) % turns
