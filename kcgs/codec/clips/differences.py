"""How Gaussians differ from the moved ones of the frame before: steps, whole numbers, and their code."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kcgs.codec.adaptive import AdaptiveSymbols
from kcgs.codec.exact import Floats, Integers, exp2
from kcgs.codec.gaussians.quantize import Parameters, opponent
from kcgs.codec.rangecoder import CodecError, Coder

# half the second derivatives of the squared error by a step in a Gaussian's frame, in units of its energy
CURVATURE = (0.5, 0.5, 0.75, 0.25, 0.75)
# square pixels: the least product of standard deviations; energies below so many distortions are as if they had them
_LEAST_PRODUCT, _LEAST_ENERGY = 0.1, 8.0
# standard deviations, and units of log scale
_LARGEST_STEP = 1.0
_LOG2_E = 1.4426950408889634
# what a number may change in a frame: standard deviations, and doublings
_MOST_CHANGE = 1024.0
_MOST_DOUBLINGS = 40.0
_MOST_STEPS = 1 << 24
# Gaussians that are coded before their models learn
_TOGETHER = 128
# classes of what a Gaussian did in the last frame: nothing, a little, much, or it was not there
STILL, CALM, BUSY, NEW = range(4)
_CALM_SUM = 3
_STRENGTHS, _SUMS = 6, 5
# kinds of numbers in the order in which they are coded: grey, place, scale, slant, hues
_GREY, _PLACE, _SCALE, _SLANT, _HUE = range(5)
_KINDS = 5
_ESCAPE = 15
_MEMORY = (300.0, 600.0)


class Differences:
    """The whole numbers of Gaussians that differ from given ones, in float64, and back.

    A Gaussian moves by (d1, d2, k11, k21, k22) in its own frame, as `kcgs.fitting.frame.move` has it to first order
    in k21, and by its colours, rotated. All steps add the distortion.
    """

    def __init__(self, base: Parameters, distortion: float, size: tuple[int, int]) -> None:
        self.base, self.distortion = base, distortion
        _, cholesky, colors = base
        pixels = float(size[0] * size[1])
        area = np.minimum(math.pi * np.maximum(cholesky[:, 0] * cholesky[:, 2], _LEAST_PRODUCT), pixels)
        strength = np.zeros(len(colors))
        for channel in range(colors.shape[1]):
            strength += colors[:, channel] * colors[:, channel]
        self.energy: Floats = strength * area / distortion
        inner = np.maximum(self.energy, _LEAST_ENERGY)
        shape = [np.minimum(np.sqrt(12.0 / (c * inner)), _LARGEST_STEP) for c in CURVATURE]
        color = np.sqrt(12.0 * distortion / area)
        self.steps: Floats = np.stack([*shape, *[color] * colors.shape[1]], -1)

    def measure(self, gaussians: Parameters) -> Floats:
        """Return how Gaussians differ, in steps [N, 5 + C]."""
        means, cholesky, colors = self.base
        l11, l21, l22 = cholesky.T
        n11, n21, n22 = gaussians.cholesky.T
        dx, dy = (gaussians.means - means).T
        d1 = dx / l11
        d2 = (dy - l21 * d1) / l22
        k11, k22 = np.log(n11 / l11), np.log(n22 / l22)
        k21 = (n21 - l21 * (n11 / l11)) / l22
        colored = opponent(gaussians.colors) - opponent(colors)
        return np.concatenate([np.stack([d1, d2, k11, k21, k22], -1), colored], 1) / self.steps

    def can_be(self, codes: Integers) -> NDArray[np.bool_]:
        """Say of each Gaussian whether a file may say that it changes so much, [N]."""
        change = np.abs(codes * self.steps)
        small = (change[:, [0, 1, 3]] <= _MOST_CHANGE).all(1) & (change[:, [2, 4]] <= _MOST_DOUBLINGS).all(1)
        return np.asarray(small & (np.abs(codes) <= _MOST_STEPS).all(1), np.bool_)

    def restore(self, codes: Integers) -> Parameters:
        """Return the Gaussians that a decoder finds, in float32."""
        means, cholesky, colors = self.base
        change = codes * self.steps
        if not self.can_be(codes).all():
            raise CodecError(f"a difference must be within {_MOST_CHANGE:g}; got {np.abs(change).max():g}")
        l11, l21, l22 = cholesky.T
        d1, d2, k11, k21, k22 = change[:, :5].T
        e1, e2 = exp2(np.stack([k11, k22]) * _LOG2_E)
        moved = np.stack([means[:, 0] + l11 * d1, means[:, 1] + (l21 * d1 + l22 * d2)], -1)
        shape = np.stack([l11 * e1, l21 * e1 + l22 * k21, l22 * e2], -1)
        colored = colors + opponent(change[:, 5:], back=True)
        return Parameters(*(numbers.astype(np.float32) for numbers in (moved, shape, colored)))

    def strengths(self) -> Integers:
        """Return classes of how many steps the Gaussians have, [N]."""
        exponent = np.frexp(np.maximum(self.energy, 1.0))[1]
        classes: Integers = np.clip(exponent // 2 - 2, 0, _STRENGTHS - 1).astype(np.int64)
        return classes


class DifferenceCoder:
    """Codes differences; what was learned in one frame helps the next."""

    def __init__(self, channels: int) -> None:
        self._channels = channels
        changed = np.array([[6.0, 1.0], [3.0, 2.0], [2.0, 3.0], [2.0, 2.0]])
        self._changed = AdaptiveSymbols(np.repeat(changed, _STRENGTHS, 0), _MEMORY[0])
        sizes, sums = np.arange(_ESCAPE + 1.0), np.arange(1.0, _SUMS + 1.0)
        table = 0.3 + 4.0 * exp2(-sizes / sums[:, None])
        self._sizes = AdaptiveSymbols(np.tile(table, (_KINDS, 1)), _MEMORY[1])

    def code(self, coder: Coder, strength: Integers, activity: Integers, codes: Integers | None) -> Integers:
        """Code whole numbers [N, 5 + C] of Gaussians, by their strength and what they did last, both [N]."""
        found = np.zeros((len(strength), 5 + self._channels), np.int64)
        for start in range(0, len(strength), _TOGETHER):
            part = slice(start, start + _TOGETHER)
            given = None if codes is None else codes[part]
            context = activity[part] * _STRENGTHS + strength[part]
            known = None if given is None else np.asarray(given.any(1), np.int64)
            changed = self._changed.code(coder, context, known)
            rows = start + np.flatnonzero(changed)
            found[rows] = self._code_changed(coder, len(rows), None if given is None else given[changed > 0])
        return found

    def _code_changed(self, coder: Coder, count: int, codes: Integers | None) -> Integers:
        found, total = np.zeros((count, 5 + self._channels), np.int64), np.zeros(count, np.int64)
        for place, kind in self._order():
            values = None if codes is None else codes[:, place]
            size = None if values is None else np.minimum(np.abs(values), _ESCAPE)
            size = self._sizes.code(coder, kind * _SUMS + np.minimum(total, _SUMS - 1), size)
            for row in np.flatnonzero(size == _ESCAPE).tolist():
                beyond = coder.unbounded(0 if values is None else abs(int(values[row])) - _ESCAPE)
                if beyond > _MOST_STEPS:
                    raise CodecError(f"a difference must be at most {_MOST_STEPS} steps; got {beyond}")
                size[row] += beyond
            sign = coder.uniform(1 + (size > 0), None if values is None else (values < 0).astype(np.int64))
            found[:, place] = np.where(sign == 1, -size, size)
            total += size
        return found

    def _order(self) -> list[tuple[int, int]]:
        hues = [(place, _HUE) for place in range(6, 5 + self._channels)]
        return [(5, _GREY), (0, _PLACE), (1, _PLACE), (2, _SCALE), (4, _SCALE), (3, _SLANT), *hues]


def busyness(codes: Integers) -> Integers:
    """Return what Gaussians did in a frame, of their whole numbers [N, 5 + C]."""
    total = np.abs(codes).sum(1)
    return np.where(total == 0, STILL, np.where(total <= _CALM_SUM, CALM, BUSY)).astype(np.int64)
