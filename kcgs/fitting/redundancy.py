"""Which Gaussians have the lowest impact on the render, once their neighbours have taken over."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcgs.kernels.compiled import Program, inner
from kcgs.kernels.tasks import first_task, next_task, ranges, run_tasks

# most neighbours that take over from a Gaussian
NEIGHBORS = 16
# normalised inner products below it do not count
LEAST_OVERLAP = 0.05
# twice the largest exponent that such a product may have
_FAR = -2.0 * math.log(LEAST_OVERLAP)
# largest square of a distance along x by the sum of variances; with room for rounding
_MOST_X = 1.001 * _FAR
# a neighbour's mean is at most so many of the Gaussian's standard deviations away: wider ones hardly overlap it
_WINDOW = 4.0
# added to the diagonal of the products of neighbours, of which two may be the same
_RIDGE = 1e-3
# columns of a row: mean, covariance, and the fourth root of its determinant
_X = 0
_Y = 1
_XX = 2
_XY = 3
_YY = 4
_ROOT = 5

# Gaussians of a task
_TASK_ROWS = 64

program = Program("choice of Gaussians to remove")


@inner
def _exponent(a, b):  # type: ignore[no-untyped-def]
    """Squared distance of two means by the sum of the covariances, times its determinant, and that."""
    x, y = a[_X] - b[_X], a[_Y] - b[_Y]
    xx, xy, yy = a[_XX] + b[_XX], a[_XY] + b[_XY], a[_YY] + b[_YY]
    return yy * x * x - 2.0 * xy * x * y + xx * y * y, xx * yy - xy * xy


@inner
def _overlap(a, b, power, det):  # type: ignore[no-untyped-def]
    return 2.0 * a[_ROOT] * b[_ROOT] / math.sqrt(det) * math.exp(-0.5 * power / det)


@inner
def _nearest(rows, start, end, i, places, values):  # type: ignore[no-untyped-def]
    """List the rows from start to end, sorted by y, that overlap row i most; return how many."""
    count, a = 0, rows[i]
    window = _WINDOW * math.sqrt(a[_YY])
    first = start + np.searchsorted(rows[start:end, _Y], a[_Y] - window)
    for j in range(first, end):
        if rows[j, _Y] > a[_Y] + window:
            break
        x = rows[j, _X] - a[_X]
        if x * x > _MOST_X * (rows[j, _XX] + a[_XX]):
            continue
        power, det = _exponent(a, rows[j])
        if j == i or power > _FAR * det:
            continue
        value = _overlap(a, rows[j], power, det)
        if value < (values[count - 1] if count == NEIGHBORS else LEAST_OVERLAP):
            continue
        count = min(count + 1, NEIGHBORS)
        k = count - 1
        while k > 0 and values[k - 1] < value:
            values[k], places[k] = values[k - 1], places[k - 1]
            k -= 1
        values[k], places[k] = value, j
    return count


@inner
def _solve(matrix, count, x):  # type: ignore[no-untyped-def]
    """Solve in place by Cholesky's factors, of which the lower triangle of the matrix becomes the first.

    Returns the inner product of the right side and the solution.
    """
    product = 0.0
    for k in range(count):
        for m in range(k + 1):
            total = matrix[k, m]
            for n in range(m):
                total -= matrix[k, n] * matrix[m, n]
            matrix[k, m] = math.sqrt(max(total, 1e-9)) if k == m else total / matrix[m, m]
        for n in range(k):
            x[k] -= matrix[k, n] * x[n]
        x[k] /= matrix[k, k]
        product += x[k] * x[k]
    for k in range(count - 1, -1, -1):
        for n in range(k + 1, count):
            x[k] -= matrix[n, k] * x[n]
        x[k] /= matrix[k, k]
    return product


@program.entry
def score(rows, spans, residuals, neighbors, shares, tasks, counters):  # type: ignore[no-untyped-def]
    """Fill, for every row: the share of its energy that its neighbours cannot explain, their places, their factors.

    Rows, all of norm 1, are sorted by region, then y; spans, (N, 2), are the first row of each one's region and the
    end. Tasks are ranges of rows.
    """
    values, matrix = np.empty(NEIGHBORS), np.empty((NEIGHBORS, NEIGHBORS))
    task = first_task(tasks, counters)
    while task >= 0:
        for i in range(tasks[task, 1], tasks[task, 2]):
            places, share = neighbors[i], shares[i]
            places[:] = -1
            count = _nearest(rows, spans[i, 0], spans[i, 1], i, places, values)
            for k in range(count):
                share[k] = values[k]
            for k in range(count):
                matrix[k, k] = 1.0 + _RIDGE
                for m in range(k):
                    power, det = _exponent(rows[places[k]], rows[places[m]])
                    matrix[k, m] = _overlap(rows[places[k]], rows[places[m]], power, det)
            residuals[i] = max(1.0 - _solve(matrix, count, share), 0.0)
        task = next_task(tasks, counters)


def lowest_impact(
    means: NDArray[Any],
    cholesky: NDArray[Any],
    colors: NDArray[Any],
    region: NDArray[Any],
    count: int,
    weight: NDArray[Any],
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    r"""Choose Gaussians to remove, and give their colours to their neighbours.

    The impact of Gaussian i is :math:`|c_i|^2 (g_{ii} - g_{iS} G_{SS}^{-1} g_{Si})`, where g are inner products over
    the plane and S are the Gaussians of its region that overlap it most; they get
    :math:`G_{SS}^{-1} g_{Si} c_i`. The lowest impact goes first; the neighbours of a removed Gaussian stay.

    Args:
        means: (N, 2), with the other three.
        cholesky: (N, 3).
        colors: (N, C).
        region: (N,), number of each one's region.
        count: how many to remove; fewer are where too many are neighbours.
        weight: (N,), the weight of the squared error about each one.

    Returns:
        A mask of those to remove, (N,), and the colours of all, (N, C).
    """
    l11, l21, l22 = cholesky.astype(np.float64).T
    yy = l21**2 + l22**2
    table = np.stack([*means.astype(np.float64).T, l11**2, l11 * l21, yy, np.sqrt(l11 * l22)], -1)
    order = np.lexsort((table[:, _Y], region))
    rows, colors = table[order], colors[order].astype(np.float64)
    spans = np.stack([np.searchsorted(region[order], region[order], side) for side in ("left", "right")], -1)
    residuals, neighbors = np.empty(len(rows)), np.empty((len(rows), NEIGHBORS), np.int64)
    shares = np.zeros(neighbors.shape)
    run_tasks(partial(score, rows, spans, residuals, neighbors, shares), ranges(len(rows), _TASK_ROWS))
    norm = math.sqrt(math.pi) * rows[:, _ROOT]
    colors *= norm[:, None]
    removed, needed = np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.bool_)
    new_colors = colors.copy()
    impacts = residuals * np.square(colors).sum(1) * weight[order]
    for i in np.argsort(impacts, kind="stable"):
        if count <= 0:
            break
        heirs = neighbors[i, : np.count_nonzero(neighbors[i] >= 0)]
        if needed[i] or removed[heirs].any():
            continue
        removed[i], needed[heirs], count = True, True, count - 1
        new_colors[heirs] += shares[i, : len(heirs), None] * colors[i]
    ranks = np.argsort(order)
    return removed[ranks], (new_colors / norm[:, None])[ranks]
