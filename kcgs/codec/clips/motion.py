"""Affine motions of regions as whole numbers, and what they do to Gaussians: the same bits on every machine."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcgs.codec.adaptive import AdaptiveNumber, AdaptiveSymbol
from kcgs.codec.exact import Integers
from kcgs.codec.gaussians.quantize import Parameters
from kcgs.codec.rangecoder import CodecError, Coder

UNIT = 1 << 16
"""What a pixel, and a factor of 1, are in the numbers of a motion, as `move_labels` takes it."""
# of a file's numbers: a factor's step in 1 / UNIT, and a shift's: a 16th of a pixel
_FACTOR, _SHIFT = 4, UNIT // 16
# the largest of a file's numbers: factors, and shifts
_MOST = np.array([1 << 16, 1 << 16, 1 << 24, 1 << 16, 1 << 16, 1 << 24], np.int64)
# the least and the largest factor by which an area may shrink
_AREAS = 1 / 64, 64.0


def quantize_motion(matrix: NDArray[Any], size: tuple[int, int]) -> Integers:
    """Round a motion, (2, 3) from a point of the new frame to where it was, to the six numbers of a file.

    They are what is added about the centre of the image: point p was at p + F (p - centre) + s. F is in steps of
    2**-14, s in 16ths of a pixel, in the order F11, F12, s1, F21, F22, s2.
    """
    centre = np.array([0.5 * size[1], 0.5 * size[0]])
    matrix = np.asarray(matrix, np.float64)
    factors = matrix[:, :2] - np.eye(2)
    steps = np.round(factors * (UNIT / _FACTOR))
    shift = matrix[:, 2] + factors @ centre
    whole = np.concatenate([steps, np.round(shift * (UNIT / _SHIFT))[:, None]], 1).reshape(6)
    numbers: Integers = np.clip(whole, -_MOST, _MOST).astype(np.int64)
    return numbers


def expand(numbers: Integers, size: tuple[int, int]) -> Integers:
    """Return motions [R, 6] as `move_labels` takes them, of the numbers of a file."""
    height, width = size
    factors = numbers[:, [0, 1, 3, 4]] * _FACTOR
    out = np.empty_like(numbers)
    out[:, [0, 1, 3, 4]] = factors + np.array([UNIT, 0, 0, UNIT])
    # half the size and the step of a factor are whole together
    out[:, 2] = numbers[:, 2] * _SHIFT - (factors[:, 0] * width + factors[:, 1] * height) // 2
    out[:, 5] = numbers[:, 5] * _SHIFT - (factors[:, 2] * width + factors[:, 3] * height) // 2
    return out


def is_allowed(motions: Integers) -> NDArray[np.bool_]:
    """Say which motions [R, 6] neither mirror nor stretch beyond reason."""
    a, b, _, d, e, _ = (motions / UNIT).T
    area = a * e - b * d
    allowed: NDArray[np.bool_] = (area > _AREAS[0]) & (area < _AREAS[1])
    return allowed


def move_gaussians(gaussians: Parameters, region: Integers, motions: Integers) -> Parameters:
    """Move Gaussians with their regions, in float64; `region` [N] says which of `motions`, from new to old."""
    a, b, c, d, e, f = (motions[region] / UNIT).T
    area = a * e - b * d
    x, y = gaussians.means.astype(np.float64).T
    dx, dy = x - c, y - f
    means = np.stack([(e * dx - b * dy) / area, (a * dy - d * dx) / area], -1)
    l11, l21, l22 = gaussians.cholesky.astype(np.float64).T
    # the inverse matrix times the factor, made lower triangular again by a rotation
    x1, x2 = (e * l11 - b * l21) / area, -b * l22 / area
    y1, y2 = (a * l21 - d * l11) / area, a * l22 / area
    first = np.sqrt(x1 * x1 + x2 * x2)
    cholesky = np.stack([first, (x1 * y1 + x2 * y2) / first, (x1 * y2 - x2 * y1) / first], -1)
    return Parameters(means, cholesky, gaussians.colors.astype(np.float64))


class MotionCoder:
    """Codes the motions of regions, each by what it is more than the region's last one."""

    def __init__(self, num_regions: int) -> None:
        self.last: Integers = np.zeros((num_regions, 6), np.int64)
        self._same = AdaptiveSymbol(np.array([2.0, 1.0]))
        self._numbers = [AdaptiveNumber(np.array([2.0, *[2.0] * 6, *[0.3] * 18])) for _ in range(2)]

    def code(self, coder: Coder, size: tuple[int, int], numbers: Integers | None) -> Integers:
        """Code the numbers [R, 6] of all regions; return motions as `move_labels` takes them."""
        moved = None if numbers is None else (numbers != self.last).any(1).astype(np.int64)
        moved = self._same.code(coder, len(self.last), moved)
        found = self.last.copy()
        for region in np.flatnonzero(moved).tolist():
            for place in range(6):
                given = None if numbers is None else int(numbers[region, place] - self.last[region, place])
                found[region, place] += self._code_number(coder, self._numbers[place % 3 == 2], given)
        if (np.abs(found) > _MOST).any():
            raise CodecError(f"numbers of a motion must be within {_MOST.tolist()}; got {found.tolist()}")
        motions = expand(found, size)
        if not is_allowed(motions).all():
            raise CodecError(f"a motion must scale areas by {_AREAS[0]:g} to {_AREAS[1]:g}; got {motions.tolist()}")
        self.last = found
        return motions

    @staticmethod
    def _code_number(coder: Coder, model: AdaptiveNumber, value: int | None) -> int:
        size = model.code(coder, None if value is None else abs(value))
        return -size if size and coder.fair(value is not None and value < 0) else size
