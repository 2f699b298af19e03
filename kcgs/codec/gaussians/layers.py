"""Gaussians coded in layers, the strongest first, so that the beginning of a file is an image.

A layer has a group for each of its classes of energy: the numbers of Gaussians by class of size, then the Gaussians
(docs/format.md).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs.codec.adaptive import AdaptiveAngle, AdaptiveMagnitude, AdaptiveNumber, AdaptiveSymbol
from kcgs.codec.exact import Floats, Integers, exp2
from kcgs.codec.rangecoder import CodecError, Coder, Reader, Writer
from kcgs.maps import RegionMap, pixels_under

from .occupancy import COUNT_BITS, OccupancyCoder
from .quantize import ENERGIES, MAX_RATIO, OCTAVES, SIZES, Classes, Codes, Parameters, Quantizer
from .shapes import ANGLE, SHAPES

_NUM_CLASSES = 64  # classes of size that a stream can name
# first weights of the models
_STRAY_WEIGHTS = np.array([20.0, 0.5])  # a Gaussian is of the region under its centre, or of another
_COUNT_WEIGHTS = np.array([2.0, *[1.0] * 9, *[0.3] * (COUNT_BITS - 9)])  # by count of bits
_RATIO_SCALE = 2.0  # scale of the magnitudes of ratios, in half the log2 of the ratio
_FIRST_RATIO_SIZE = -1  # class of size of the first context of ratios; smaller classes share it
_LEVELS = 8  # scales of the magnitudes of colours, within a class of size
# magnitude of a channel, in the Gaussian's amplitude, above which the next channel's context is 1, or 2
_MEDIUM = 0.35
_STRONG = 0.8
# symbols after a group
_END = 0  # the layer ends
_PRESENT = 1  # a group of the next lower class of energy follows
_ABSENT = 2  # there is no group of this class
Group = tuple[Codes, Integers]
"""Gaussians of one class of energy, and the indices of their regions."""


class LayerCoder:
    """Write or read layers one after another, with models that learn from all layers so far.

    The map is on the CPU. One procedure, `_code`, both writes and reads, so that both agree; it takes values, which a
    reader ignores.
    """

    def __init__(self, quantizer: Quantizer, channels: int, regions: RegionMap | None) -> None:
        self.quantizer, self.channels, self.regions = quantizer, channels, regions
        self.num_regions = 1 if regions is None else regions.num_regions
        *self._colors, self._ratio = (AdaptiveMagnitude(shapes) for shapes in SHAPES)  # grey, hue, hue2
        self._angle = AdaptiveAngle(ANGLE)
        self._strays = AdaptiveSymbol(_STRAY_WEIGHTS)
        self._count = AdaptiveNumber(_COUNT_WEIGHTS)
        self._occupancy = OccupancyCoder(quantizer.size)

    def write(self, writer: Writer, groups: list[Group]) -> None:
        """Write a layer of groups in the order of a file: the highest class of energy first."""
        self._code(writer, int(groups[0][0].energy[0]), groups, sum(len(ids) for _, ids in groups))

    def read(self, reader: Reader, energy: int, max_count: int) -> list[tuple[Parameters, Integers]]:
        """Read the groups of a layer from class `energy` on; more than `max_count` Gaussians are an error."""
        return self._code(reader, energy, [], max_count)

    def _code(
        self, coder: Coder, energy: int, groups: list[Group], max_count: int
    ) -> list[tuple[Parameters, Integers]]:
        coded, remaining = [], list(groups)
        symbol = _PRESENT
        while symbol != _END:
            if symbol == _PRESENT:
                group = remaining.pop(0) if remaining else self._placeholders(1)
                coded.append(self._code_group(coder, energy, group, max_count))
                max_count -= len(coded[-1][1])
            energy -= 1
            symbol = coder.number(_next_symbol(remaining, energy), 3)
            if symbol != _END and energy < ENERGIES[0]:
                raise CodecError(f"a class of energy must be at least {ENERGIES[0]}; got {energy}")
        return coded

    def _placeholders(self, count: int) -> Group:
        """Return the values that a reader passes in place of a group."""
        one, two, colors = (np.broadcast_to(np.int64(0), (count, *row)) for row in ((), (2,), (self.channels,)))
        return Codes(one, one, one, one, one, colors, two, two), one

    def _code_group(self, coder: Coder, energy: int, group: Group, max_count: int) -> tuple[Parameters, Integers]:
        """Code at most `max_count` Gaussians of one energy."""
        counts = self._code_counts(coder, group[0].size)
        if counts.sum() > max_count:
            raise CodecError(f"a layer must hold at most {max_count} Gaussians; got {counts.sum()}")
        if counts[SIZES[1] - SIZES[0] + 1 :].any():
            raise CodecError(f"a class of size must be at most {SIZES[1]}; got {np.flatnonzero(counts)[-1] + SIZES[0]}")
        if not counts.any():
            raise CodecError("a layer must hold Gaussians; got none")
        codes, ids = self._placeholders(int(counts.sum())) if coder.is_reader else group
        cells, start = [], 0
        for size in np.flatnonzero(counts)[::-1].tolist():
            end = start + int(counts[size])
            cells.append(self._occupancy.code(coder, size + SIZES[0], codes.cell[start:end]))
            start = end
        size = np.repeat(np.arange(_NUM_CLASSES)[::-1], counts[::-1]) + SIZES[0]
        classes = Classes(np.full(start, energy), size)
        gaussians = self._code_parameters(coder, classes, np.concatenate(cells), codes)
        return gaussians, self._code_regions(coder, gaussians.means, ids)

    def _code_counts(self, coder: Coder, sizes: Integers) -> Integers:
        """Code the number of Gaussians of each class of size."""
        counts = np.bincount(sizes - SIZES[0], minlength=_NUM_CLASSES)
        present = np.flatnonzero(counts)
        first = int(coder.uniform(np.array([_NUM_CLASSES]), present[:1])[0])
        last = first + int(coder.uniform(np.array([_NUM_CLASSES - first]), present[-1:] - first)[0])
        coded = np.zeros(_NUM_CLASSES, np.int64)
        for size in range(first, last + 1):
            coded[size] = self._count.code(coder, int(counts[size]))
        return coded

    def _code_parameters(self, coder: Coder, classes: Classes, cell: Integers, codes: Codes) -> Parameters:
        """Code all numbers of Gaussians except their cells."""
        steps = self.quantizer.steps(classes)
        scale = coder.uniform(steps.num_scales, codes.scale)
        ratio = self._code_ratios(coder, classes, float(steps.ratio[0]), codes.ratio)
        num_angles = steps.num_angles(ratio)
        angle = self._angle.code(coder, num_angles, codes.angle)
        # amplitude of this class of energy, in steps of colour, for a scale in the middle of its class
        amplitude = math.ldexp(math.sqrt(math.pi / (12.0 * self.quantizer.distortion)), int(classes.energy[0]))
        amplitudes = amplitude * exp2(OCTAVES * (0.5 - (np.arange(_LEVELS) + 0.5) / _LEVELS))
        level = (_LEVELS * scale + _LEVELS // 2) // steps.num_scales
        colors = self._code_colors(coder, amplitudes, level, codes.colors)
        shape = steps.shape(scale, ratio, angle / num_angles)
        axes = zip(steps.num_places(shape).T, codes.place.T, strict=True)
        places = [coder.uniform(num_places, place) for num_places, place in axes]
        return steps.dequantize(Codes(*classes, scale, ratio, angle, colors, cell, np.stack(places, -1)), shape)

    def _code_ratios(self, coder: Coder, classes: Classes, step: float, ratios: Integers) -> Integers:
        """Code the ratios of scales; `step` is the group's step of a ratio."""
        context = np.clip(classes.size - _FIRST_RATIO_SIZE, 0, len(SHAPES.ratio) - 1)
        level = np.zeros_like(context)
        ratio = self._ratio.code(coder, np.array([_RATIO_SCALE / step]), level, context, ratios)
        max_ratio = math.floor(MAX_RATIO / step + 0.5)
        if (ratio > max_ratio).any():
            raise CodecError(f"a ratio must be at most {max_ratio} steps; got {ratio.max()}")
        return ratio

    def _code_colors(self, coder: Coder, amplitudes: Floats, level: Integers, colors: Integers) -> Integers:
        """Code colours channel by channel; `level` [N] is the index of each Gaussian's amplitude."""
        channels: list[Integers] = []
        for channel in range(self.channels):
            context = np.zeros(len(level), np.int64)
            if channel:
                last, amplitude = np.abs(channels[-1]), amplitudes[level]
                context = (last > _MEDIUM * amplitude).astype(np.int64) + (last > _STRONG * amplitude)
            model, values = self._colors[min(channel, len(self._colors) - 1)], colors[:, channel]
            magnitude = model.code(coder, amplitudes, level, context, np.abs(values))
            sign = coder.uniform(1 + (magnitude > 0), (values < 0).astype(np.int64))
            channels.append(np.where(sign == 1, -magnitude, magnitude))
        return np.stack(channels, -1)

    def _code_regions(self, coder: Coder, means: NDArray[Any], ids: Integers) -> Integers:
        """Code the index of each Gaussian's region: the region under its centre, or another."""
        if self.regions is None:
            return np.zeros(len(means), np.int64)
        row, column = pixels_under(torch.from_numpy(means), self.regions.size)
        coded = self.regions.index[0, row, column].numpy().astype(np.int64)
        strays = self._strays.code(coder, (ids != coded).astype(np.int64))
        index = np.flatnonzero(strays)
        # distance from the index of the region under the centre, modulo the number of regions
        distance = (ids[index] - coded[index] - 1) % self.num_regions
        distance = coder.uniform(np.full(len(index), self.num_regions - 1), distance)
        coded[index] = (coded[index] + 1 + distance) % self.num_regions
        return coded


def _next_symbol(remaining: list[Group], energy: int) -> int:
    """Return the symbol that an encoder writes before this class of energy; a decoder ignores it."""
    if not remaining:
        return _END
    return _PRESENT if remaining[0][0].energy[0] == energy else _ABSENT
