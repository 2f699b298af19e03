"""Adaptive models: chances that are learned from each symbol as it is coded (docs/format.md).

All numbers are float64; every sum goes from left to right, every operation is rounded once.
"""

from __future__ import annotations

import itertools

import numpy as np

from .exact import Floats, Integers
from .rangecoder import ONE, Coder

_MIN_CHANCE = 64  # least chance of a value of an adaptive bit, in 1 / ONE

# buckets of magnitudes
_SINGLES = 16  # smaller magnitudes have a bucket each
_FIRST_OCTAVE = 4  # log2 of the least magnitude that shares a bucket
_LAST_OCTAVE = 24  # log2 of the least magnitude that is too large
_PER_OCTAVE = 8  # buckets of equal width per octave
_SHARED_LOW = [
    (1 << octave - 3) * eighth
    for octave in range(_FIRST_OCTAVE, _LAST_OCTAVE)
    for eighth in range(_PER_OCTAVE, 2 * _PER_OCTAVE)
]
_LOW = np.array([*range(_SINGLES), *_SHARED_LOW], np.int64)  # least magnitude of each bucket
_HIGH = np.append(_LOW[1:], 1 << _LAST_OCTAVE)  # least magnitude above each bucket
_BORDERS = np.maximum(np.append(_LOW, _HIGH[-1]) - 0.5, 0.0)  # halfway between magnitudes
_FLOOR = 1e-3  # share of the total weight that is divided equally among the buckets

# the shape that all scales share
_BINS = 24
_BIN_WIDTH = 0.125  # in scales
_PARTS = 256  # unit of the share of a magnitude in a bin: 1 / _PARTS
_GROUP = 1 << 12  # magnitudes whose tables are in memory at a time

_ANGLE_BINS = 16  # bins of half a turn


class AdaptiveBit:
    """A bit whose chance is learned; the first chance is 1/2."""

    def __init__(self) -> None:
        self._ones = 2
        self._total = 4

    def code(self, coder: Coder, value: bool) -> bool:
        """Code the bit."""
        chance = min(max(self._ones * ONE // self._total, _MIN_CHANCE), ONE - _MIN_CHANCE)
        bit = bool(coder.bits(np.array([chance / ONE]), np.array([value], np.int32))[0])
        self._ones += 2 * bit
        self._total += 2
        return bit


class AdaptiveSymbol:
    """One of a few symbols, whose weights are learned; `weights` are the first ones."""

    def __init__(self, weights: Floats) -> None:
        self._weights = weights.copy()

    def code(self, coder: Coder, values: Integers) -> Integers:
        """Code symbols, (n,)."""
        symbols = coder.categorical(self._weights, values)
        np.add.at(self._weights, symbols, 1.0)
        return symbols


class AdaptiveNumber:
    """A number whose count of bits is learned; `weights` are the first weights of the counts 0, 1, 2 and so on."""

    def __init__(self, weights: Floats) -> None:
        self._length = AdaptiveSymbol(weights)

    def code(self, coder: Coder, value: int) -> int:
        """Code the number: its count of bits, then the remainder below its highest bit."""
        length = int(self._length.code(coder, np.array([value.bit_length()]))[0])
        highest = 1 << (length - 1) if length else 0
        return highest + int(coder.uniform(np.array([max(highest, 1)]), np.array([value - highest]))[0])


class AdaptiveMagnitude:
    """Magnitudes 0, 1, 2 ... of known scales; all scales share a learned distribution of magnitude / scale.

    `shapes` [contexts, bins] are the first weights of the bins; each context learns its own shape.
    """

    def __init__(self, shapes: Floats) -> None:
        self._shapes = shapes.copy()

    def code(self, coder: Coder, scales: Floats, level: Integers, context: Integers, values: Integers) -> Integers:
        """Code one magnitude for each entry of `level` [n], its index in `scales`, and of `context` [n]."""
        present, level = np.unique(level, return_inverse=True)
        present_scales = scales[present].tolist()
        tables = np.concatenate([self._tables(scale) for scale in present_scales])
        bucket = np.searchsorted(_LOW, values, side="right") - 1
        bucket = coder.mixed_categorical(tables, level * len(self._shapes) + context, bucket)
        width = _HIGH[bucket] - _LOW[bucket]
        magnitudes = _LOW[bucket] + coder.uniform(width, values - _LOW[bucket])
        parts = np.zeros(self._shapes.shape)
        for i, scale in enumerate(present_scales):
            index = level == i
            parts += self._spread(scale, context[index], magnitudes[index])
        self._shapes += parts / _PARTS
        return magnitudes

    def _tables(self, scale: float) -> Floats:
        """Return the weights of the buckets, [contexts, buckets]: integrals of the piecewise constant shape.

        Sums and interpolation are written out, since numpy may sum in another order.
        """
        total = np.array([list(itertools.accumulate(shape, initial=0.0)) for shape in self._shapes.tolist()])
        edges: Floats = np.arange(_BINS + 1.0) * (scale * _BIN_WIDTH)
        index = np.minimum(np.searchsorted(edges, _BORDERS, side="right") - 1, _BINS - 1)
        share = np.minimum((_BORDERS - edges[index]) / (edges[index + 1] - edges[index]), 1.0)
        low = total.take(index, 1)
        cumulative: Floats = low + share * (total.take(index + 1, 1) - low)
        tables: Floats = (cumulative[:, 1:] - cumulative[:, :-1]) + _FLOOR * total[:, -1:] / len(_LOW)
        return tables

    def _spread(self, scale: float, context: Integers, magnitudes: Integers) -> Floats:
        """Spread each magnitude over the bins that round to it, in whole parts: their sums are exact in any order."""
        edges = np.arange(_BINS + 1) * (scale * _BIN_WIDTH)
        edges[-1] = np.inf
        num_contexts = len(self._shapes)
        kinds, counts = np.unique(magnitudes * num_contexts + context, return_counts=True)
        parts = np.zeros(self._shapes.shape)
        for start in range(0, len(kinds), _GROUP):
            group = slice(start, start + _GROUP)
            magnitude, row = np.divmod(kinds[group], num_contexts)
            low, high = np.maximum(magnitude - 0.5, 0.0)[:, None], (magnitude + 0.5)[:, None]
            overlap = np.maximum(np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1]), 0.0) / (high - low)
            share = np.floor(overlap * _PARTS + 0.5) * counts[group, None]
            bins = row[:, None] * _BINS + np.arange(_BINS)
            parts += np.bincount(bins.ravel(), share.ravel(), parts.size).reshape(parts.shape)
        return parts


class AdaptiveAngle:
    """Angles in steps of half a turn; `weights` are the first weights of bins around 0, 1/16, 2/16 ... of it."""

    def __init__(self, weights: Floats) -> None:
        self._weights = weights.copy()

    def code(self, coder: Coder, num_angles: Integers, values: Integers) -> Integers:
        """Code angles (n,), each below its entry of `num_angles` (n,); only entries of 16 or more have bins."""
        has_bin = num_angles >= _ANGLE_BINS
        # half a bin: angle 0 is in the middle of the first bin
        shift = np.where(has_bin, num_angles // (2 * _ANGLE_BINS), 0)
        shifted = (values + shift) % num_angles
        counts, row = np.unique(num_angles[has_bin], return_inverse=True)
        borders = np.arange(_ANGLE_BINS + 1) * counts[:, None] // _ANGLE_BINS
        bins = np.zeros(0, np.int64)
        if len(row):
            symbols = (borders[row, 1:] <= shifted[has_bin, None]).sum(1)
            bins = coder.mixed_categorical(self._weights * np.diff(borders), row, symbols)
        low, sizes = np.zeros(len(num_angles), np.int64), num_angles.copy()
        low[has_bin] = borders[row, bins]
        sizes[has_bin] = borders[row, bins + 1] - low[has_bin]
        angles = low + coder.uniform(sizes, shifted - low)
        np.add.at(self._weights, bins, 1.0)
        return (angles - shift) % num_angles
