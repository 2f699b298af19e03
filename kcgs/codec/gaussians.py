"""The numbers of Gaussians, coded: a layer for each class of energy, the strongest first, so that a part is a picture.

A layer tells, for each class of size, how many Gaussians there are, and then what each is. The order of a sum is free:
within a class Gaussians go by the cell that they lie in, row by row, and only how many lie in each cell is told.

The stream of a layer
---------------------

Bytes are as in `labels`; Uniforms, Choices and Magnitudes are those of `models`, `quantize` says what numbers mean.
Models begin with the file and go on from layer to layer. Each line below is coded for all Gaussians of the layer before
the next one begins, in their order: by class of size, the largest first, then by cell, row by row.

1. Counts. The least class of size that is held, from -8: Uniform of 64, f; the last one, from that: Uniform of 64 - f.
   No class is above 28. For each of them, rising: the count's number of bits by the Choices ``lengths``, alone, then
   the count less its highest bit, a Uniform of that bit. A layer holds a Gaussian at least.
2. Cells, class by class, falling, of those that hold any: `cells`.
3. ``scale``: Uniform of S.
4. ``ratio``: the Magnitudes ``ratio`` with t = 2 / (the step of the ratio); at most floor(12 / step + 1/2).
5. ``angle``: Uniform of T.
6. Colours, channel by channel: the size by the Magnitudes ``grey``, ``hue`` and ``hue2`` of the first, the second,
   and all later channels, with t = loud = sqrt(pi / (12 D)) * 2**energy; then the sign, 1 if negative: Uniform of 2, of
   1 where the size is 0. The context is 0 in the first channel; else, a being the size of the channel before, 2 if
   a > 0.8 loud, 1 if a > 0.35 loud, else 0.
7. Place in the cell, across: Uniform of X; then down: Uniform of Y.
8. If the file has R > 1 regions: whether the Gaussian's region is another than that under its centre (that of the label
   at floor(x), floor(y) as float32, clamped to the picture), by the Choices ``stays``; then for those of which it is,
   Uniform of R - 1: the region's position among the sorted ids, less that under the centre, less 1, modulo R.

Weights at the start are those in the code: ``grey`` (one context), ``hue`` and ``hue2`` (three each, all alike) and
``ratio`` are 0.05 times the tables below; ``stays`` 20, 0.5; ``lengths`` 2, nine times 1, twelve times 0.3; ``margins``
3, four times 1, four times 0.3.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .cells import Cells
from .errors import CodecError
from .models import Choices, Magnitudes
from .quantize import SIZES, Classes, Codes, Quantizer, Restored
from .rangecoder import Coder

Integers = NDArray[np.int64]
# positions among the map's ids under centres (N, 2), float32
Lookup = Callable[[NDArray[np.float32]], Integers]

_MOST_BITS = 21
# half the log2 of the ratio of scales is measured in this
_RATIO_SCALE = 2.0
# a colour's part is faint, middling or strong against the whole
_FAINT, _STRONG = 0.35, 0.8
# where learning starts: shapes found on photos that no report measures, in parts of a thousand
_GREY = np.array([1, 1, 2, 3, 12, 22, 49, 80, 102, 110, 110, 103, 88, 74, 62, 46, 34, 27, 22, 17, 12, 6, 6, 12])
_HUE = np.array([382, 247, 144, 96, 51, 30, 21, 12, 7, 3, 2, 2, 1, 1, *[0.5] * 10])
_HUE2 = np.array([547, 224, 98, 63, 27, 13, 12, 9, 5, 1, 1, *[0.5] * 13])
_RATIO = np.array([102, 159, 168, 150, 125, 98, 69, 46, 30, 21, 14, 8, 5, 3, 2, 1, *[0.5] * 8])
# what a start weighs against what is seen, in Gaussians
_WEIGHT = 0.05


class Layers:
    """Codes layers one after another; what was learned in one helps the next.

    Args:
        quantizer: of the file.
        channels: of the colours.
        regions: how many regions there are.
        lookup: the region under a centre; read only where there are more than one.
    """

    def __init__(self, quantizer: Quantizer, channels: int, regions: int, lookup: Lookup | None) -> None:
        self.quantizer, self.channels, self.regions, self.lookup = quantizer, channels, regions, lookup
        self._colors = [Magnitudes(_WEIGHT * _GREY), Magnitudes(_WEIGHT * _HUE, 3), Magnitudes(_WEIGHT * _HUE2, 3)]
        self._ratio = Magnitudes(_WEIGHT * _RATIO)
        self._stays = Choices(np.array([20.0, 0.5]))
        self._lengths = Choices(np.array([2.0, *[1.0] * 9, *[0.3] * (_MOST_BITS - 9)]))
        self._cells = Cells(quantizer.size)

    def code(
        self, coder: Coder, energy: int, codes: Codes | None, ids: Integers | None, most: int
    ) -> tuple[Restored, Integers]:
        """Code the layer of one energy; return its Gaussians and their regions.

        Args:
            coder: writes or reads.
            energy: of the layer.
            codes: the layer's Gaussians, sorted by `layer_order`; None: to read.
            ids: their regions, as positions among the map's ids.
            most: more Gaussians than this are refused.

        Raises:
            CodecError: a stream that names more.
        """
        counts = None if codes is None else np.bincount(codes.classes.size - SIZES[0], minlength=64)
        counts = self._code_counts(coder, counts)
        if counts.sum() > most:
            raise CodecError(f"a layer must hold at most {most} Gaussians; got {counts.sum()}")
        if counts[SIZES[1] - SIZES[0] + 1 :].any():
            raise CodecError(f"a class of size must be at most {SIZES[1]}; got {np.flatnonzero(counts)[-1] + SIZES[0]}")
        if not counts.any():
            raise CodecError("a layer must hold Gaussians; got none")
        cells, start = [], 0
        for count in counts[counts > 0][::-1].tolist():
            own = None if codes is None else codes.cell[start : start + count]
            cells.append(self._cells.code(coder, count, own))
            start += count
        size = np.repeat(np.arange(64)[::-1], counts[::-1]) + SIZES[0]
        classes = Classes(np.full(start, energy), size)
        found = self._code_numbers(coder, classes, np.concatenate(cells), codes)
        return found, self._code_regions(coder, found.means, ids)

    def _code_counts(self, coder: Coder, counts: Integers | None) -> Integers:
        one = np.ones(1, np.int64)
        held = None if counts is None else np.flatnonzero(counts)
        first = int(coder.uniform(64 * one, None if held is None else held[:1])[0])
        span = int(coder.uniform((64 - first) * one, None if held is None else held[-1:] - first)[0]) + 1
        found = np.zeros(64, np.int64)
        for size in range(first, first + span):
            value = None if counts is None else counts[size : size + 1]
            length = None if value is None else np.array([int(value[0]).bit_length()])
            length = self._lengths.code(coder, 0 * one, length)
            low = one << max(int(length[0]) - 1, 0) if length[0] else 0 * one
            found[size] = (low + coder.uniform(np.maximum(low, 1), None if value is None else value - low))[0]
        return found

    def _code_numbers(self, coder: Coder, classes: Classes, cell: Integers, codes: Codes | None) -> Restored:
        quantizer = self.quantizer
        steps, side = quantizer.steps(classes), quantizer.cell_side(classes)
        zero = np.zeros(len(cell), np.int64)
        scale = coder.uniform(steps.scales, None if codes is None else codes.scale)
        ratio = self._ratio.code(coder, _RATIO_SCALE / steps.ratio[0], zero, None if codes is None else codes.ratio)
        if (ratio > quantizer.most_ratio(steps)).any():
            raise CodecError(f"a ratio must be at most {quantizer.most_ratio(steps)[0]} steps; got {ratio.max()}")
        turns = quantizer.angles(ratio, steps)
        angle = coder.uniform(turns, None if codes is None else codes.angle)
        # how many steps the amplitude of a Gaussian of this energy has
        loud = math.ldexp(math.sqrt(math.pi / (12.0 * quantizer.noise)), int(classes.energy[0]))
        colors = self._code_colors(coder, len(cell), loud, None if codes is None else codes.colors)
        shape = quantizer.restore_shape(classes, steps, scale, ratio, angle / turns)
        parts = quantizer.parts(shape, steps, side)
        place = [coder.uniform(parts[:, axis], None if codes is None else codes.place[:, axis]) for axis in range(2)]
        found = Codes(classes, scale, ratio, angle, colors, cell, np.stack(place, -1))
        return quantizer.restore_rest(found, steps, shape, side)

    def _code_colors(self, coder: Coder, count: int, loud: float, colors: Integers | None) -> Integers:
        channels: list[Integers] = []
        for channel in range(self.channels):
            context = np.zeros(count, np.int64)
            if channel:
                last = np.abs(channels[-1])
                context = (last > _FAINT * loud).astype(np.int64) + (last > _STRONG * loud)
            value = None if colors is None else colors[:, channel]
            model = self._colors[min(channel, 2)]
            size = model.code(coder, loud, context, None if value is None else np.abs(value))
            sign = coder.uniform(1 + (size > 0), None if value is None else (value < 0).astype(np.int64))
            channels.append(np.where(sign == 1, -size, size))
        return np.stack(channels, -1)

    def _code_regions(self, coder: Coder, means: NDArray[np.float32], ids: Integers | None) -> Integers:
        if self.lookup is None or self.regions == 1:
            return np.zeros(len(means), np.int64)
        under = self.lookup(means)
        strays = None if ids is None else (ids != under).astype(np.int64)
        strays = self._stays.code(coder, np.zeros(len(under), np.int64), strays)
        away = np.flatnonzero(strays)
        # any but the one under it
        others = None if ids is None else (ids[away] - under[away] - 1) % self.regions
        step = coder.uniform(np.full(len(away), self.regions - 1), others)
        found = under.copy()
        found[away] = (under[away] + 1 + step) % self.regions
        return found


def layer_order(codes: Codes) -> Integers:
    """Return the order that Gaussians are told in: by energy, then size, falling; then by cell, row by row."""
    column, row = codes.cell.T
    return np.lexsort((column, row, -codes.classes.size, -codes.classes.energy))


def pick(codes: Codes, index: Integers | slice | NDArray[np.bool_]) -> Codes:
    """Return some of the Gaussians."""
    return Codes(Classes(*(t[index] for t in codes.classes)), *(t[index] for t in codes[1:]))


def join(parts: list[Codes]) -> Codes:
    """Return the Gaussians of all parts."""
    classes = Classes(*(np.concatenate(t) for t in zip(*(p.classes for p in parts), strict=True)))
    return Codes(classes, *(np.concatenate(t) for t in zip(*(p[1:] for p in parts), strict=True)))
