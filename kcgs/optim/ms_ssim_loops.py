"""The compiled loops of the objective `ms-ssim`, over the rows of its scales."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kcgs.compiled.program import Program, inner
from kcgs.compiled.tasks import first_task, next_task
from kcgs.functional import K1, K2

# half the window of SSIM, in pixels
MARGIN = 5
# rows of zeros above and below padded planes
PADDING = 12
# columns of the table of scales
HEIGHT = 0
WIDTH = 1
START = 2  # pixels of finer scales
PADDED_START = 3  # elements of finer scales' padded planes
WINDOW_START = 4  # windows of finer scales
# columns of tasks, after the first
PHASE = 1
SCALE = 2
CHANNEL = 3
FIRST = 4
LAST = 5  # last row + 1
# phases
HALVE = 0  # average blocks of the difference for the rows of all scales
SCORE = 1  # the score of a scale, and the gradient by its pixels without the factor of the mean score
SUM = 2  # the gradient by the pixels of the image

program = Program("objective of MS-SSIM")


class Scales(NamedTuple):
    """All scales of an image or a batch, flat, finest first.

    Windows lie at even rows and columns. Zeros lie around `padded` planes: 5 rows above and 7 below, 5 columns beside.
    """

    table: Any  # [S, 5] int64
    channels: int  # C, for a batch the sum over its images
    factors: Any  # [S, C] float64: weight of a window over the norm of its image
    least: float  # least mean score of a scale
    taps: Any  # [6] of the window, its centre first
    image: Any  # padded, C
    inside: Any  # of windows: inverse of the sum of taps inside the image
    mean: Any  # of windows, C, of the image
    variance: Any  # of windows, C
    render: Any  # padded, C, written to
    planes: Any  # C: averages of the difference, then the gradient


@inner
def _taps(scales):
    """Return the taps as numbers: a compiler must assume that a store to another array changes an array."""
    taps = scales.taps
    return taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]


@inner
def _pixel(plane, other, y, x):
    """Return a value of a plane, or of its product with another."""
    return plane[y, x] if other is None else plane[y, x] * other[y, x]


@inner
def _blur_columns(plane, other, y, taps, upper, lower):
    """Blur a padded plane, or the product of two, along columns, at rows y and y + 2."""
    for x in range(plane.shape[1]):
        first, second = taps[0] * _pixel(plane, other, y + MARGIN, x), taps[0] * _pixel(plane, other, y + MARGIN + 2, x)
        for k in range(1, MARGIN + 1):
            above, below = y + MARGIN - k, y + MARGIN + k
            first += taps[k] * (_pixel(plane, other, above, x) + _pixel(plane, other, below, x))
            second += taps[k] * (_pixel(plane, other, above + 2, x) + _pixel(plane, other, below + 2, x))
        upper[x], lower[x] = first, second


@inner
def _blur_row(row, taps, target):
    """Blur a row of a padded plane, for the windows of a row."""
    for x in range(len(target)):
        k = 2 * x
        even_part = taps[0] * row[k + 5] + taps[2] * (row[k + 3] + row[k + 7]) + taps[4] * (row[k + 1] + row[k + 9])
        odd_part = taps[1] * (row[k + 4] + row[k + 6]) + taps[3] * (row[k + 2] + row[k + 8])
        target[x] = even_part + odd_part + taps[5] * (row[k] + row[k + 10])


@inner
def _spread_columns(slopes, k, taps, upper, lower):
    """Spread windows along columns to two rows of pixels: the row of window row k + 2, and the next row."""
    for x in range(slopes.shape[1]):
        a, b, c = slopes[k, x], slopes[k + 1, x], slopes[k + 2, x]
        d, e, f = slopes[k + 3, x], slopes[k + 4, x], slopes[k + 5, x]
        upper[x] = taps[0] * c + taps[2] * (b + d) + taps[4] * (a + e)
        lower[x] = taps[1] * (c + d) + taps[3] * (b + e) + taps[5] * (a + f)


@inner
def _spread_row(row, taps, target):
    """Spread windows along a row to its columns; three zeros lie on either side."""
    for x in range(len(target) // 2):
        a, b, c, d, e, f = row[x + 1], row[x + 2], row[x + 3], row[x + 4], row[x + 5], row[x + 6]
        target[2 * x] = taps[0] * c + taps[2] * (b + d) + taps[4] * (a + e)
        target[2 * x + 1] = taps[1] * (c + d) + taps[3] * (b + e) + taps[5] * (a + f)


@inner
def _plane(scales, scale, channel):
    """Return a plane of averages of the difference, or of the gradient."""
    table = scales.table
    height, width = table[scale, HEIGHT], table[scale, WIDTH]
    start = scales.channels * table[scale, START] + channel * height * width
    return scales.planes[start : start + height * width].reshape(height, width)


@inner
def _padded(flat, scales, scale, channel):
    """Return a padded plane."""
    table = scales.table
    height, width = table[scale, HEIGHT] + PADDING, table[scale, WIDTH] + 2 * MARGIN
    start = scales.channels * table[scale, PADDED_START] + channel * height * width
    return flat[start : start + height * width].reshape(height, width)


@inner
def _windows(flat, scales, scale, index, count):
    """Return array `index` of the `count` arrays that hold a number for each window of a scale."""
    table = scales.table
    height, width = (table[scale, HEIGHT] + 1) // 2, (table[scale, WIDTH] + 1) // 2
    start = count * table[scale, WINDOW_START] + index * height * width
    return flat[start : start + height * width].reshape(height, width)


@inner
def _halve(scales, difference, channel, first, last):
    """Fill averages of blocks, and the render, on all scales, for rows `first` to `last` of the finest scale."""
    table, quarter = scales.table, np.float32(0.25)
    for scale in range(len(table)):
        target = _plane(scales, scale, channel)
        image = _padded(scales.image, scales, scale, channel)
        render = _padded(scales.render, scales, scale, channel)
        source = difference[channel] if scale == 0 else _plane(scales, scale - 1, channel)
        for y in range(first >> scale, last >> scale):
            upper, lower, row = source[2 * y], source[2 * y + 1], target[y]
            for x in range(len(row)):
                row[x] = quarter * ((upper[2 * x] + lower[2 * x]) + (upper[2 * x + 1] + lower[2 * x + 1]))
            image_row, render_row = image[y + MARGIN, MARGIN:], render[y + MARGIN, MARGIN:]
            for x in range(len(row)):
                render_row[x] = image_row[x] + row[x]


@inner
def _score_row(rows, inside, mean, variance, scores, slopes):
    """Fill a row of scores, and their slopes by mean square, mean product and mean of the render."""
    means, squares, products = rows[0], rows[1], rows[2]
    by_square, by_product, by_mean = slopes
    zero, two, c2 = np.float32(0.0), np.float32(2.0), np.float32(K2**2)
    for x in range(len(scores)):
        share, m = inside[x], inside[x] * means[x]
        spread = share * squares[x] - m * m
        inverse = np.float32(1.0) / ((spread if spread > zero else zero) + variance[x] + c2)
        structure = (two * (share * products[x] - mean[x] * m) + c2) * inverse
        slope = share * inverse
        scores[x] = structure
        by_product[x] = slope
        by_square[x] = slope * structure
        by_mean[x] = slope * mean[x] - slope * structure * m


@inner
def _multiply_by_luminance(means, inside, mean, scores, slopes):
    """Multiply a row of scores by the luminance."""
    by_square, by_product, by_mean = slopes
    two, c1 = np.float32(2.0), np.float32(K1**2)
    for x in range(len(scores)):
        m = inside[x] * means[x]
        both = mean[x] * mean[x] + m * m + c1
        luminance = (two * mean[x] * m + c1) / both
        slope = inside[x] * scores[x] * (luminance * m - mean[x]) / both
        scores[x] *= luminance
        by_square[x] *= luminance
        by_product[x] *= luminance
        by_mean[x] = by_mean[x] * luminance + slope


@inner
def _score(scales, scale, channel, first, last, has_gradient):
    """Fill rows of the gradient by the pixels of a scale, from an even row; return the sum of the windows' scores."""
    taps = _taps(scales)
    render = _padded(scales.render, scales, scale, channel)
    image = _padded(scales.image, scales, scale, channel)
    inside = _windows(scales.inside, scales, scale, 0, 1)
    mean = _windows(scales.mean, scales, scale, channel, scales.channels)
    variance = _windows(scales.variance, scales, scale, channel, scales.channels)
    height, width = inside.shape
    columns = np.empty((3, 2, render.shape[1]), np.float32)
    rows = np.empty((3, width), np.float32)
    scores, totals = np.empty(width, np.float32), np.zeros(width)
    first_window, last_window = first // 2, (last + 1) // 2
    # with the windows above and below that the gradient depends on
    above, below = (2, 3) if has_gradient else (0, 0)
    slopes = np.zeros((3, last_window - first_window + 6, width + 6), np.float32)
    end = min(last_window + below, height)
    for top in range(max(first_window - above, 0), end, 2):
        _blur_columns(render, None, 2 * top, taps, columns[0, 0], columns[0, 1])
        _blur_columns(render, render, 2 * top, taps, columns[1, 0], columns[1, 1])
        _blur_columns(render, image, 2 * top, taps, columns[2, 0], columns[2, 1])
        for y in range(top, min(top + 2, end)):
            for k in range(3):
                _blur_row(columns[k, y - top], taps, rows[k])
            k = y - first_window + 2
            by = slopes[0, k, 3:-3], slopes[1, k, 3:-3], slopes[2, k, 3:-3]
            _score_row(rows, inside[y], mean[y], variance[y], scores, by)
            if scale == len(scales.table) - 1:
                _multiply_by_luminance(rows[0], inside[y], mean[y], scores, by)
            if first_window <= y < last_window:
                for x in range(width):
                    totals[x] += scores[x]
    if has_gradient:
        _spread(scales, scale, channel, first, last, slopes)
    total = 0.0
    for x in range(width):
        total += totals[x]
    return total


@inner
def _spread(scales, scale, channel, first, last, slopes):
    """Fill rows of the gradient by the pixels of a scale, from the slopes of the scores of windows."""
    taps = _taps(scales)
    render = _padded(scales.render, scales, scale, channel)
    image = _padded(scales.image, scales, scale, channel)
    target = _plane(scales, scale, channel)
    width = slopes.shape[2] - 6
    columns, rows = np.empty((3, 2, width + 6), np.float32), np.empty((3, 2 * width), np.float32)
    for top in range(first, last, 2):
        for k in range(3):
            _spread_columns(slopes[k], (top - first) // 2, taps, columns[k, 0], columns[k, 1])
        for y in range(top, min(top + 2, last)):
            for k in range(3):
                _spread_row(columns[k, y - top], taps, rows[k])
            _sum_slopes(rows, render[y + MARGIN, MARGIN:], image[y + MARGIN, MARGIN:], target[y])


@inner
def _sum_slopes(rows, render, image, target):
    """Turn three rows of slopes, by mean square, mean product and mean, into the gradient."""
    by_square, by_product, by_mean = rows[0], rows[1], rows[2]
    for x in range(len(target)):
        target[x] = by_square[x] * render[x] - by_product[x] * image[x] + by_mean[x]


@inner
def _mean_score(scales, sums, tasks, scale, channel):
    """Return the mean score of a channel's windows, at least `least`, from the sums of the tasks."""
    total = 0.0
    for k in range(len(tasks)):
        if tasks[k, PHASE] == SCORE and tasks[k, SCALE] == scale and tasks[k, CHANNEL] == channel:
            total += sums[k]
    windows = ((scales.table[scale, HEIGHT] + 1) // 2) * ((scales.table[scale, WIDTH] + 1) // 2)
    return max(total / windows, scales.least)


@inner
def _add_coarser(row, factor, coarse):
    """Multiply a row by a factor, and add to each pixel the value of its block in a coarser row."""
    for x in range(len(coarse)):
        row[2 * x] = row[2 * x] * factor + coarse[x]
        row[2 * x + 1] = row[2 * x + 1] * factor + coarse[x]
    for x in range(2 * len(coarse), len(row)):
        row[x] *= factor


@inner
def _sum_scales(scales, difference, squared, sums, tasks, k):
    """Fill rows of the gradient by the image's pixels: gradients of coarser scales are added to finer scales."""
    table, channel = scales.table, tasks[k, CHANNEL]
    first, last = tasks[k, FIRST], tasks[k, LAST]
    nothing = np.empty(0, np.float32)
    for scale in range(len(table) - 1, -1, -1):
        factor = np.float32(scales.factors[scale, channel] / _mean_score(scales, sums, tasks, scale, channel))
        plane = _plane(scales, scale, channel)
        has_coarse = scale + 1 < len(table)
        coarse = _plane(scales, scale + has_coarse, channel)
        rows = table[scale + 1, HEIGHT] if has_coarse else 0
        for y in range(first >> scale, last >> scale):
            _add_coarser(plane[y], factor, coarse[y // 2] if y // 2 < rows else nothing)
    plane = _plane(scales, 0, channel)
    end = difference.shape[1] if last == len(plane) else 2 * last
    for y in range(2 * first, end):
        _add_coarser(difference[channel, y], np.float32(squared), plane[y // 2] if y // 2 < len(plane) else nothing)


@program.entry
def run_phases(scales, difference, squared, sums, has_gradient, tasks, counters):
    """Fill the sums of scores, (T,) by task; with the last phase replace a difference by half the gradient."""
    k = first_task(tasks, counters)
    while k >= 0:
        phase, scale, channel = tasks[k, PHASE], tasks[k, SCALE], tasks[k, CHANNEL]
        first, last = tasks[k, FIRST], tasks[k, LAST]
        if phase == HALVE:
            _halve(scales, difference, channel, first, last)
        elif phase == SCORE:
            sums[k] = _score(scales, scale, channel, first, last, has_gradient)
        else:
            _sum_scales(scales, difference, squared, sums, tasks, k)
        k = next_task(tasks, counters, k)
