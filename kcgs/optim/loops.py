"""The step of `adam.py` in compiled loops: tables of float32 on the CPU, intermediate numbers in float64.

With torch operations a fit takes 16 to 20 % longer.
"""

from __future__ import annotations

import math

import numpy as np

from kcgs.compiled.program import Program, inner
from kcgs.compiled.tasks import END_ROW, FIRST_ROW, first_task, next_task

program = Program("optimizer")


@inner
def _clamp(value, low, high):
    return min(max(value, low), high)  # NaN stays NaN


@inner
def _adam(numbers, average, square, adam, age):
    """Replace gradients of one age by Adam's steps, and update their averages."""
    rate, root = adam.lr / (1.0 - adam.beta1**age), 1.0 / math.sqrt(1.0 - adam.beta2**age)
    for i in range(len(numbers)):
        gradient = np.float64(numbers[i])
        mean = average[i] + (1.0 - adam.beta1) * (gradient - average[i])
        power = adam.beta2 * square[i] + (1.0 - adam.beta2) * gradient * gradient
        average[i], square[i] = mean, power
        numbers[i] = -rate * mean / (root * math.sqrt(power) + adam.eps)


@inner
def _adam_rows(numbers, adam, begin):
    """Replace gradients [N, K], of rows from `begin` on, by Adam's steps; adjacent rows of one age go together.

    Rows of a negative age are frozen: their step is 0.
    """
    first, columns = 0, numbers.shape[1]
    average, square, flat = adam.average.ravel(), adam.square.ravel(), numbers.ravel()
    while first < len(numbers):
        last, age = first, adam.age[begin + first, 0]
        while last < len(numbers) and adam.age[begin + last, 0] == age:
            adam.age[begin + last, 0] += 0 if age < 0 else 1
            last += 1
        part = slice((begin + first) * columns, (begin + last) * columns)
        if age < 0:
            flat[first * columns : last * columns] = 0.0
        else:
            _adam(flat[first * columns : last * columns], average[part], square[part], adam, np.float64(age + 1))
        first = last


@inner
def _widen(l11, l21, l22, min_sigma):
    """Return the factor of `frame.widen`."""
    xx, xy, yy, least = l11 * l11, l11 * l21, l21 * l21 + l22 * l22, min_sigma * min_sigma
    if xx >= least and (xx - least) * (yy - least) >= xy * xy:
        return l11, l21, l22
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    gap = math.sqrt(half * half + xy * xy)
    long, short = mean + gap, (l11 * l22) ** 2 / (mean + gap)
    new_long, new_short = max(long, least), max(short, least)
    isotropic, minor = new_long - long, (new_short - short) - (new_long - long)
    cos, sin = (half / gap, xy / gap) if gap > 0.0 else (0.0, 0.0)
    w11 = math.sqrt(xx + isotropic + 0.5 * minor * (1.0 - cos))
    return w11, (xy - 0.5 * minor * sin) / w11, math.sqrt(new_long * new_short) / w11


@program.entry
def is_within(tables, limit):
    """Return whether the absolute value of every number of tables is below a limit, and none is NaN."""
    within = True
    for numbers in tables:
        for i in range(len(numbers)):
            within &= abs(numbers[i]) < limit
    return within


@program.entry
def step_geometry(tables, gradients, moves, adam, bounds, tasks, counters):
    """Move means [N, 2] and factors [N, 3]; `moves` says which of the two is not frozen. Tasks are ranges of rows."""
    k = first_task(tasks, counters)
    while k >= 0:
        _step_geometry(tables, gradients, moves, adam, bounds, (tasks[k, FIRST_ROW], tasks[k, END_ROW]))
        k = next_task(tasks, counters, k)


@inner
def _step_geometry(tables, gradients, moves, adam, bounds, rows):
    means, cholesky = tables
    means_gradient, cholesky_gradient = gradients
    begin, end = rows
    steps = np.empty((end - begin, 5), np.float32)
    # frame.local_gradient
    for i in range(begin, end):
        l11, l21, l22 = cholesky[i, 0], cholesky[i, 1], cholesky[i, 2]
        gx, gy = means_gradient[i, 0], means_gradient[i, 1]
        g11, g21, g22 = cholesky_gradient[i, 0], cholesky_gradient[i, 1], cholesky_gradient[i, 2]
        step = steps[i - begin]
        step[0], step[1] = l11 * gx + l21 * gy, l22 * gy
        step[2], step[3], step[4] = l11 * g11 + l21 * g21, l22 * g21, l22 * g22
    _adam_rows(steps, adam, begin)
    # frame.move, then adam.within_bounds
    most, max_factor = bounds.max_step, bounds.max_factor
    for i in range(begin, end):
        step = steps[i - begin]
        l11, l21, l22 = np.float64(cholesky[i, 0]), np.float64(cholesky[i, 1]), np.float64(cholesky[i, 2])
        d1, d2 = _clamp(np.float64(step[0]), -most, most), _clamp(np.float64(step[1]), -most, most)
        x, y = means[i, 0] + l11 * d1, means[i, 1] + l21 * d1 + l22 * d2
        k11, k22 = _clamp(np.float64(step[2]), -most, most), _clamp(np.float64(step[4]), -most, most)
        k21, e1, e2, gap = _clamp(np.float64(step[3]), -most, most), math.exp(k11), math.exp(k22), k11 - k22
        mean = 0.5 * (e1 + e2) if abs(gap) < 1e-4 else (e1 - e2) / gap
        l21 = _clamp(l21 * e1 + l22 * k21 * mean, -max_factor, max_factor)
        l11, l22 = _clamp(l11 * e1, bounds.min_factor, max_factor), _clamp(l22 * e2, bounds.min_factor, max_factor)
        if moves[0]:
            outside_x, outside_y = bounds.max_outside * l11, bounds.max_outside * math.sqrt(l21 * l21 + l22 * l22)
            means[i, 0] = _clamp(x, -outside_x, bounds.width + outside_x)
            means[i, 1] = _clamp(y, -outside_y, bounds.height + outside_y)
        if moves[1]:
            cholesky[i, 0], cholesky[i, 1], cholesky[i, 2] = _widen(l11, l21, l22, bounds.min_sigma)


@program.entry
def step_tables(tables, gradient, adam):
    """Move tables by their gradients, which are side by side in one array [N, K]."""
    steps, column = gradient.copy(), 0
    _adam_rows(steps, adam, 0)
    for table in tables:
        for i in range(len(table)):
            for k in range(table.shape[1]):
                table[i, k] += steps[i, column + k]
        column += table.shape[1]
