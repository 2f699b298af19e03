"""The steps of `gaussian_adam.py` in compiled loops: tables of float32 on the CPU, numbers in between in float64."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from kcgs.kernels.compiled import Program, inner

program = Program("optimizer", __file__)


class Adam(NamedTuple):
    """Settings of a group, and the averages of its tables beside each other, K columns."""

    lr: float
    beta1: float
    beta2: float
    eps: float
    age: Any  # [N, 1]
    average: Any  # [N, K]
    square: Any  # [N, K]


class Bounds(NamedTuple):
    """Bounds of a step, in standard deviations and log scale, and of a field's geometry, in pixels."""

    max_step: float
    height: float
    width: float
    min_sigma: float
    min_factor: float
    max_outside: float  # in standard deviations


@inner
def _clamp(value, low, high):  # type: ignore[no-untyped-def]
    return min(max(value, low), high)  # NaN stays NaN


@inner
def _corrections(adam, age):  # type: ignore[no-untyped-def]
    """Factors of an average and of the root of a square, which began at zero."""
    return -adam.lr / (1.0 - adam.beta1**age), 1.0 / math.sqrt(1.0 - adam.beta2**age)


@inner
def _step(adam, corrections, i, k, gradient):  # type: ignore[no-untyped-def]
    """Update the averages of a number, and return its step."""
    average, square = np.float64(adam.average[i, k]), np.float64(adam.square[i, k])
    average += (1.0 - adam.beta1) * (gradient - average)
    square = adam.beta2 * square + (1.0 - adam.beta2) * gradient * gradient
    adam.average[i, k], adam.square[i, k] = average, square
    return corrections[0] * average / (corrections[1] * math.sqrt(square) + adam.eps)


@inner
def _widen(l11, l21, l22, min_sigma):  # type: ignore[no-untyped-def]
    """A factor whose standard deviations are at least `min_sigma`: `frame.widen`."""
    xx, xy, yy, least = l11 * l11, l11 * l21, l21 * l21 + l22 * l22, min_sigma * min_sigma
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    gap = math.sqrt(half * half + xy * xy)
    long, short = mean + gap, (l11 * l22) ** 2 / (mean + gap)
    if not short < least:
        return l11, l21, l22
    new_long = max(long, least)
    isotropic, minor = new_long - long, (least - short) - (new_long - long)
    cos, sin = (half / gap, xy / gap) if gap > 0.0 else (0.0, 0.0)
    w11 = math.sqrt(xx + isotropic + 0.5 * minor * (1.0 - cos))
    return w11, (xy - 0.5 * minor * sin) / w11, math.sqrt(new_long * least) / w11


@program.entry
def is_finite(numbers):  # type: ignore[no-untyped-def]
    """True where every number of a row is finite."""
    finite = True
    for i in range(len(numbers)):
        finite &= abs(numbers[i]) < np.inf
    return finite


@program.entry
def step_geometry(means, cholesky, means_gradient, cholesky_gradient, moves, adam, bounds):  # type: ignore[no-untyped-def]
    """Move means [N, 2] and factors [N, 3]; `moves` says which of the two is not frozen."""
    age, corrections = 0.0, (0.0, 0.0)
    diagonal = math.hypot(bounds.height, bounds.width)
    for i in range(len(means)):
        adam.age[i, 0] += 1
        if adam.age[i, 0] != age:
            age = np.float64(adam.age[i, 0])
            corrections = _corrections(adam, age)
        l11, l21, l22 = np.float64(cholesky[i, 0]), np.float64(cholesky[i, 1]), np.float64(cholesky[i, 2])
        gx, gy = np.float64(means_gradient[i, 0]), np.float64(means_gradient[i, 1])
        g11, g21, g22 = cholesky_gradient[i, 0], cholesky_gradient[i, 1], cholesky_gradient[i, 2]
        most = bounds.max_step
        d1 = _clamp(_step(adam, corrections, i, 0, l11 * gx + l21 * gy), -most, most)
        d2 = _clamp(_step(adam, corrections, i, 1, l22 * gy), -most, most)
        k11 = _clamp(_step(adam, corrections, i, 2, l11 * g11 + l21 * g21), -most, most)
        k21 = _clamp(_step(adam, corrections, i, 3, l22 * g21), -most, most)
        k22 = _clamp(_step(adam, corrections, i, 4, l22 * g22), -most, most)

        x, y = means[i, 0] + l11 * d1, means[i, 1] + l21 * d1 + l22 * d2
        e1, e2, gap = math.exp(k11), math.exp(k22), k11 - k22
        mean = 0.5 * (e1 + e2) if abs(gap) < 1e-4 else (e1 - e2) / gap
        l11, l21, l22 = l11 * e1, l21 * e1 + l22 * k21 * mean, l22 * e2

        l11, l22 = _clamp(l11, bounds.min_factor, diagonal), _clamp(l22, bounds.min_factor, diagonal)
        l21 = _clamp(l21, -diagonal, diagonal)
        if moves[0]:
            outside_x, outside_y = bounds.max_outside * l11, bounds.max_outside * math.sqrt(l21 * l21 + l22 * l22)
            means[i, 0] = _clamp(x, -outside_x, bounds.width + outside_x)
            means[i, 1] = _clamp(y, -outside_y, bounds.height + outside_y)
        if moves[1]:
            cholesky[i, 0], cholesky[i, 1], cholesky[i, 2] = _widen(l11, l21, l22, bounds.min_sigma)


@program.entry
def step_table(table, gradient, column, adam):  # type: ignore[no-untyped-def]
    """Move a table whose averages begin at a column; the first one makes the averages older."""
    age, corrections = 0.0, (0.0, 0.0)
    for i in range(len(table)):
        if column == 0:
            adam.age[i, 0] += 1
        if adam.age[i, 0] != age:
            age = np.float64(adam.age[i, 0])
            corrections = _corrections(adam, age)
        for k in range(table.shape[1]):
            table[i, k] += _step(adam, corrections, i, column + k, np.float64(gradient[i, k]))
