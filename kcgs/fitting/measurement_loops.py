"""The errors of a render in one pass over memory; with torch operations a fit takes 8 to 10 % longer."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from kcgs.compiled.program import Program, inner
from kcgs.compiled.tasks import END_ROW, FIRST_ROW, first_task, next_task, ranges, run_tasks

program = Program("measurement of a fit")

# least columns per task
_COLUMNS = 64
# pixels per thread
_THREAD_PIXELS = 1 << 16


def mean_errors(rendered: Any, image: Any, band: Any, *, is_squared: bool) -> Any:
    """Return three means, (B, 3), for each image of renders (B, C, H, W).

    They are the mean error, absolute or squared; the mean squared error of the clipped render; and the same over the
    pixels of `band`, NaN without such pixels. Rows of `band`, (M, 3), are image, row and column, in the order of
    images.
    """
    batch, _, height, width = rendered.shape
    loss, squares = np.zeros((batch, width)), np.zeros((batch, width))
    loop = partial(_sum_columns, rendered, image, is_squared, loss, squares)
    run_tasks(loop, ranges(batch * width, _COLUMNS), batch * height * width, _THREAD_PIXELS)
    return _mean(rendered, image, band, loss, squares)


@inner
def _clipped_error(value, target):
    return (min(max(value, type(value)(0)), type(value)(1)) - target) ** 2


@program.entry
def _sum_columns(rendered, image, is_squared, loss, squares, tasks, counters):
    """Add up the errors of each column; tasks are ranges of columns, numbered across all images."""
    _, channels, height, width = rendered.shape
    k = first_task(tasks, counters)
    while k >= 0:
        first, last = tasks[k, FIRST_ROW], tasks[k, END_ROW] - 1
        for b in range(first // width, last // width + 1):
            begin, end = max(first - b * width, 0), min(last + 1 - b * width, width)
            for c in range(channels):
                for y in range(height):
                    for x in range(begin, end):
                        difference = rendered[b, c, y, x] - image[b, c, y, x]
                        loss[b, x] += difference * difference if is_squared else abs(difference)
                        squares[b, x] += _clipped_error(rendered[b, c, y, x], image[b, c, y, x])
        k = next_task(tasks, counters, k)


@program.entry
def _mean(rendered, image, band, loss, squares):
    """Return the means over all columns, and over the band."""
    batch, channels, height, width = rendered.shape
    means = np.empty((batch, 3))
    first = 0
    for b in range(batch):
        end = first
        while end < len(band) and band[end, 0] == b:
            end += 1
        inside = 0.0
        for c in range(channels):
            for i in range(first, end):
                y, x = band[i, 1], band[i, 2]
                inside += _clipped_error(rendered[b, c, y, x], image[b, c, y, x])
        values = channels * height * width
        means[b] = loss[b].sum() / values, squares[b].sum() / values, inside / (channels * (end - first))
        first = end
    return means
