"""What is likely: adaptive tables of weights for the numbers of a Gaussian."""

from __future__ import annotations

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
_EDGES = np.append(_LOW, _HIGH[-1]).astype(np.float64)


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
        tables = np.stack([self._table(shape, scale) for shape in self._shape])
        bucket = None if sizes is None else np.searchsorted(_LOW, sizes, side="right") - 1
        bucket = coder.choose(tables, context, bucket)
        width = _HIGH[bucket] - _LOW[bucket]
        found = _LOW[bucket] + coder.uniform(width, None if sizes is None else sizes - _LOW[bucket])
        self._learn(scale, context, found)
        return found

    def _learn(self, scale: float, context: Integers, sizes: Integers) -> None:
        # a size stands for what rounds to it; in whole parts, whose sums no order changes
        edges = np.arange(_BINS + 1) * (scale * _WIDTH)
        edges[-1] = np.inf
        learned = np.zeros(self._shape.shape, np.int64)
        for part in batches(len(sizes)):
            low, high = np.maximum(sizes[part] - 0.5, 0.0)[:, None], (sizes[part] + 0.5)[:, None]
            overlap = np.clip(np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1]), 0.0, None) / (high - low)
            np.add.at(learned, context[part], np.floor(overlap * _PARTS + 0.5).astype(np.int64))
        self._shape += learned / _PARTS

    @staticmethod
    def _table(shape: Floats, scale: float) -> Floats:
        # the share of each bucket: the integral of the shape between its bounds, by linear interpolation
        total = np.zeros(_BINS + 1)
        for i in range(_BINS):  # not cumsum: its order of summation is its own
            total[i + 1] = total[i] + shape[i]
        edges = np.arange(_BINS + 1).astype(np.float64) * (scale * _WIDTH)
        cumulative = _interpolate(np.maximum(_EDGES - 0.5, 0.0), edges, total)
        table: Floats = (cumulative[1:] - cumulative[:-1]) + 1e-3 * total[-1] / _BUCKETS
        return table


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
    # numpy's own interpolation may order its operations otherwise
    at = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    share = np.clip((x - edges[at]) / (edges[at + 1] - edges[at]), 0.0, 1.0)
    return heights[at] + share * (heights[at + 1] - heights[at])
