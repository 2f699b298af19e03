"""The numbers of Gaussians, coded in layers, the strongest first, so that a part is an image.

A layer has a group for each of its classes of energy: by class of size, how many Gaussians, then each (docs/format.md).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs.codec.adaptive import AdaptiveAngle, AdaptiveMagnitude, AdaptiveNumber, AdaptiveSymbol
from kcgs.codec.exact import Floats, Integers, exp2
from kcgs.codec.rangecoder import CodecError, Coder
from kcgs.functional import RegionMap
from kcgs.functional.labels import lookup_regions

from .occupancy import MOST_BITS, Occupancy
from .quantize import ENERGIES, MOST_RATIO, OCTAVES, SIZES, Classes, Codes, Parameters, Quantizer
from .shapes import ANGLE, SHAPES

_CLASSES = 64  # that a stream may name, of size
# half the log2 of the ratio of scales is measured in this
_RATIO_SCALE = 2.0
# a colour's part is faint, middling or strong against the whole
_FAINT, _STRONG = 0.35, 0.8
# sizes within a class, by which colours are measured
_LEVELS = 8
# the first of the classes of size that have ratios of their own
_LEAST_SIZE = -1
# what follows a group: no other, that of the next energy down, or of an energy below that
_END, _HOLDS, _EMPTY = 0, 1, 2
Group = tuple[Codes, Integers]
"""Gaussians of one energy, and the positions of their regions' ids."""


class LayerCoder:
    """Codes layers one after another; what was learned in one helps the next. The map is on the CPU."""

    def __init__(self, quantizer: Quantizer, channels: int, regions: RegionMap | None) -> None:
        self.quantizer, self.channels, self.regions = quantizer, channels, regions
        self.num_regions = 1 if regions is None else regions.num_regions
        self._magnitudes = [AdaptiveMagnitude(shapes) for shapes in SHAPES]
        self._angle = AdaptiveAngle(ANGLE)
        self._strays = AdaptiveSymbol(np.array([20.0, 0.5]))
        self._count = AdaptiveNumber(np.array([2.0, *[1.0] * 9, *[0.3] * (MOST_BITS - 9)]))
        self._occupancy = Occupancy(quantizer.size)

    def code(
        self, coder: Coder, energy: int, groups: list[Group] | None, most: int
    ) -> list[tuple[Parameters, Integers]]:
        """Code a layer, at most so many Gaussians, as groups of falling energies, the first of which is given.

        Returns the Gaussians of each group and the positions of their regions' ids. `groups` are in the order of
        a file; None: to read.
        """
        found, waiting = [], None if groups is None else list(groups)
        following = _HOLDS
        while following != _END:
            if following == _HOLDS:
                found.append(self._code_group(coder, energy, None if waiting is None else waiting.pop(0), most))
                most -= len(found[-1][1])
            energy -= 1
            if waiting is not None:
                following = _EMPTY if waiting else _END
                if waiting and waiting[0][0].energy[0] == energy:
                    following = _HOLDS
            following = coder.number(following, 3)
            if following != _END and energy < ENERGIES[0]:
                raise CodecError(f"a class of energy must be at least {ENERGIES[0]}; got {energy}")
        return found

    def _code_group(self, coder: Coder, energy: int, group: Group | None, most: int) -> tuple[Parameters, Integers]:
        """Code the Gaussians of one energy, at most so many."""
        codes, ids = (None, None) if group is None else group
        counts = self._code_counts(coder, codes)
        if counts.sum() > most:
            raise CodecError(f"a layer must hold at most {most} Gaussians; got {counts.sum()}")
        if counts[SIZES[1] - SIZES[0] + 1 :].any():
            raise CodecError(f"a class of size must be at most {SIZES[1]}; got {np.flatnonzero(counts)[-1] + SIZES[0]}")
        if not counts.any():
            raise CodecError("a layer must hold Gaussians; got none")
        cells, start = [], 0
        for size in np.flatnonzero(counts)[::-1].tolist():
            end = start + int(counts[size])
            known = None if codes is None else codes.cell[start:end]
            cells.append(self._occupancy.code(coder, size + SIZES[0], end - start, known))
            start = end
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
        steps = self.quantizer.steps(classes)
        scale = coder.uniform(steps.scales, None if codes is None else codes.scale)
        context = np.clip(classes.size - _LEAST_SIZE, 0, len(SHAPES.ratio) - 1)
        given = None if codes is None else codes.ratio
        ratio = self._magnitudes[-1].code(coder, _RATIO_SCALE / steps.ratio[:1], np.zeros_like(context), context, given)
        if (ratio > (most := math.floor(MOST_RATIO / steps.ratio[0] + 0.5))).any():
            raise CodecError(f"a ratio must be at most {most} steps; got {ratio.max()}")
        turns = steps.turns(ratio)
        angle = self._angle.code(coder, turns, None if codes is None else codes.angle)
        # how many steps the amplitude of a Gaussian of this energy has, where it is as large as the middle of its class
        loud = math.ldexp(math.sqrt(math.pi / (12.0 * self.quantizer.distortion)), int(classes.energy[0]))
        level = (_LEVELS * scale + _LEVELS // 2) // steps.scales
        scales = loud * exp2(OCTAVES * (0.5 - (np.arange(_LEVELS) + 0.5) / _LEVELS))
        colors = self._code_colors(coder, scales, level, None if codes is None else codes.colors)
        shape = steps.shape(scale, ratio, angle / turns)
        parts = steps.places(shape)
        place = [coder.uniform(parts[:, axis], None if codes is None else codes.place[:, axis]) for axis in range(2)]
        return steps.restore(Codes(*classes, scale, ratio, angle, colors, cell, np.stack(place, -1)), shape)

    def _code_colors(self, coder: Coder, scales: Floats, level: Integers, colors: Integers | None) -> Integers:
        channels: list[Integers] = []
        for channel in range(self.channels):
            context = np.zeros(len(level), np.int64)
            if channel:
                last, loud = np.abs(channels[-1]), scales[level]
                context = (last > _FAINT * loud).astype(np.int64) + (last > _STRONG * loud)
            value = None if colors is None else colors[:, channel]
            model = self._magnitudes[min(channel, 2)]
            magnitude = model.code(coder, scales, level, context, None if value is None else np.abs(value))
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
