"""The numbers of Gaussians, coded: a layer for each class of energy, the strongest first, so that a part is an image.

A layer holds, for each class of size, how many Gaussians there are, and then what each is (docs/format.md).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs.codec.adaptive import AdaptiveMagnitude, AdaptiveNumber, AdaptiveSymbol
from kcgs.codec.exact import Integers
from kcgs.codec.rangecoder import CodecError, Coder
from kcgs.functional import RegionMap
from kcgs.functional.labels import lookup_regions

from .occupancy import Occupancy
from .quantize import MOST_RATIO, SIZES, Classes, Codes, Parameters, Quantizer

_CLASSES = 64  # that a stream may name, of size
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


class LayerCoder:
    """Codes layers one after another; what was learned in one helps the next. The map is on the CPU."""

    def __init__(self, quantizer: Quantizer, channels: int, regions: RegionMap | None) -> None:
        self.quantizer, self.channels, self.regions = quantizer, channels, regions
        self.num_regions = 1 if regions is None else regions.num_regions
        shapes = (_GREY, 1), (_HUE, 3), (_HUE2, 3)
        self._colors = [AdaptiveMagnitude(_WEIGHT * bins, contexts) for bins, contexts in shapes]
        self._ratio = AdaptiveMagnitude(_WEIGHT * _RATIO)
        self._strays = AdaptiveSymbol(np.array([20.0, 0.5]))
        self._count = AdaptiveNumber(np.array([2.0, *[1.0] * 9, *[0.3] * (_MOST_BITS - 9)]))
        self._occupancy = Occupancy(quantizer.size)

    def code(
        self, coder: Coder, energy: int, codes: Codes | None, ids: Integers | None, most: int
    ) -> tuple[Parameters, Integers]:
        """Code the layer of one energy, at most so many Gaussians; return them and the positions of their regions' ids.

        `codes` is in the order of a file; None: to read.
        """
        counts = self._code_counts(coder, codes)
        if counts.sum() > most:
            raise CodecError(f"a layer must hold at most {most} Gaussians; got {counts.sum()}")
        if counts[SIZES[1] - SIZES[0] + 1 :].any():
            raise CodecError(f"a class of size must be at most {SIZES[1]}; got {np.flatnonzero(counts)[-1] + SIZES[0]}")
        if not counts.any():
            raise CodecError("a layer must hold Gaussians; got none")
        cells, start = [], 0
        for count in counts[counts > 0][::-1].tolist():
            known = None if codes is None else codes.cell[start : start + count]
            cells.append(self._occupancy.code(coder, count, known))
            start += count
        size = np.repeat(np.arange(_CLASSES)[::-1], counts[::-1]) + SIZES[0]
        classes = Classes(np.full(start, energy), size)
        gaussians = self._code_numbers(coder, classes, np.concatenate(cells), codes)
        return gaussians, self._code_regions(coder, gaussians.means, ids)

    def _code_counts(self, coder: Coder, codes: Codes | None) -> Integers:
        """Code how many Gaussians there are of each class of size."""
        counts = None if codes is None else np.bincount(codes.size - SIZES[0], minlength=_CLASSES)
        one = np.ones(1, np.int64)
        present = None if counts is None else np.flatnonzero(counts)
        first = int(coder.uniform(_CLASSES * one, None if present is None else present[:1])[0])
        left = _CLASSES - first
        span = int(coder.uniform(left * one, None if present is None else present[-1:] - first)[0]) + 1
        found = np.zeros(_CLASSES, np.int64)
        for size in range(first, first + span):
            found[size] = self._count.code(coder, None if counts is None else int(counts[size]))
        return found

    def _code_numbers(self, coder: Coder, classes: Classes, cell: Integers, codes: Codes | None) -> Parameters:
        steps, zero = self.quantizer.steps(classes), np.zeros(len(cell), np.int64)
        scale = coder.uniform(steps.scales, None if codes is None else codes.scale)
        ratio = self._ratio.code(coder, _RATIO_SCALE / steps.ratio[0], zero, None if codes is None else codes.ratio)
        if (ratio > (most := math.floor(MOST_RATIO / steps.ratio[0] + 0.5))).any():
            raise CodecError(f"a ratio must be at most {most} steps; got {ratio.max()}")
        turns = steps.turns(ratio)
        angle = coder.uniform(turns, None if codes is None else codes.angle)
        # how many steps the amplitude of a Gaussian of this energy has
        loud = math.ldexp(math.sqrt(math.pi / (12.0 * self.quantizer.distortion)), int(classes.energy[0]))
        colors = self._code_colors(coder, len(cell), loud, None if codes is None else codes.colors)
        shape = steps.shape(scale, ratio, angle / turns)
        parts = steps.places(shape)
        place = [coder.uniform(parts[:, axis], None if codes is None else codes.place[:, axis]) for axis in range(2)]
        return steps.restore(Codes(*classes, scale, ratio, angle, colors, cell, np.stack(place, -1)), shape)

    def _code_colors(self, coder: Coder, count: int, loud: float, colors: Integers | None) -> Integers:
        channels: list[Integers] = []
        for channel in range(self.channels):
            context = np.zeros(count, np.int64)
            if channel:
                last = np.abs(channels[-1])
                context = (last > _FAINT * loud).astype(np.int64) + (last > _STRONG * loud)
            value = None if colors is None else colors[:, channel]
            model = self._colors[min(channel, 2)]
            magnitude = model.code(coder, loud, context, None if value is None else np.abs(value))
            sign = coder.uniform(1 + (magnitude > 0), None if value is None else (value < 0).astype(np.int64))
            channels.append(np.where(sign == 1, -magnitude, magnitude))
        return np.stack(channels, -1)

    def _code_regions(self, coder: Coder, means: NDArray[Any], ids: Integers | None) -> Integers:
        if self.regions is None:
            return np.zeros(len(means), np.int64)
        labels = lookup_regions(torch.from_numpy(means), self.regions.labels)
        under = self.regions.index_of(labels).numpy().astype(np.int64)
        strays = self._strays.code(coder, len(under), None if ids is None else (ids != under).astype(np.int64))
        away = np.flatnonzero(strays)
        # any but the one under it
        others = None if ids is None else (ids[away] - under[away] - 1) % self.num_regions
        step = coder.uniform(np.full(len(away), self.num_regions - 1), others)
        found = under.copy()
        found[away] = (under[away] + 1 + step) % self.num_regions
        return found
