"""Compiled loops of matching pursuit: the gains of round Gaussians of one size, and the greedy choice among them."""

from __future__ import annotations

import math

import numpy as np
from numba.extending import intrinsic

from kcgs.kernels.compiled import Program, inner
from kcgs.kernels.tasks import first_task, next_task

# candidates of which the largest gain is kept
_BLOCK = 128

program = Program("matching pursuit")


@intrinsic
def _fma(typing_context, a, b, c):  # type: ignore[no-untyped-def]
    """Return a * b + c, rounded once."""
    return a(a, b, c), lambda context, builder, signature, arguments: builder.fma(*arguments)


@inner
def _blur_row(plane, y, left, right, taps, line, blurred):  # type: ignore[no-untyped-def]
    """Blur row y of a plane, surrounded by zeros, from column `left` to `right`; `line` has zeros at both ends."""
    reach, (height, width) = len(taps) // 2, plane.shape
    first, last = max(left - reach, 0), min(right + reach, width)
    middle = line[first + reach : last + reach]
    middle[:] = 0.0
    for t in range(max(reach - y, 0), min(height + reach - y, len(taps))):
        tap, row = taps[t], plane[y + t - reach, first:last]
        for x in range(len(middle)):
            middle[x] = _fma(row[x], tap, middle[x])  # type: ignore[call-arg]
    blurred[left:right] = 0.0
    for t in range(len(taps)):
        tap, row, target = taps[t], line[left + t : right + t], blurred[left:right]
        for x in range(len(target)):
            target[x] = _fma(row[x], tap, target[x])  # type: ignore[call-arg]


@program.entry
def find_best_places(planes, taps, norm_taps, area, squares, tasks, counters):  # type: ignore[no-untyped-def]
    """Find the place of the largest gain in each square of pixels; tasks are ranges of rows of squares.

    Planes, (R, C + 1, h, w), are the residual and the mask of regions. Squares, numbered by row through all regions,
    are gains, (R, H, W), -1 where there is none; places, y * w + x; and there <g, residual>, (R, H, W, C), and <g, g>.
    Taps are those of g and g^2, for pixels of this area.
    """
    gains, places, products, norms = squares
    channels, height, width = planes.shape[1] - 1, planes.shape[2], planes.shape[3]
    side = height // gains.shape[1]
    line, norm_line = np.zeros(width + len(taps), planes.dtype), np.zeros(width + len(norm_taps), planes.dtype)
    gain, norm = np.empty((side, width), planes.dtype), np.empty((side, width), planes.dtype)
    product = np.empty((channels, side, width), planes.dtype)
    task = first_task(tasks, counters)
    while task >= 0:
        for number in range(tasks[task, 1], tasks[task, 2]):
            region, square = number // gains.shape[1], number % gains.shape[1]
            for dy in range(side):
                y = square * side + dy
                gain[dy] = -1.0
                left, right = _extent(planes[region, channels, y])
                if left == right:
                    continue
                for c in range(channels):
                    _blur_row(planes[region, c], y, left, right, taps, line, product[c, dy])
                _blur_row(planes[region, channels], y, left, right, norm_taps, norm_line, norm[dy])
                row = slice(left, right)
                _fill_gains(planes[region, channels, y, row], area, product[:, dy, row], norm[dy, row], gain[dy, row])
            for col in range(gains.shape[2]):
                best, best_dy, best_x = gain[0, col * side], 0, col * side
                for dy in range(side):
                    for x in range(col * side, (col + 1) * side):
                        if gain[dy, x] > best:
                            best, best_dy, best_x = gain[dy, x], dy, x
                gains[region, square, col] = best
                places[region, square, col] = (square * side + best_dy) * width + best_x
                norms[region, square, col] = norm[best_dy, best_x]
                for c in range(channels):
                    products[region, square, col, c] = product[c, best_dy, best_x]
        task = next_task(tasks, counters)


@inner
def _extent(mask):  # type: ignore[no-untyped-def]
    """Return the first column of a row of a mask, and the end; equal where there is none."""
    left, right = 0, len(mask)
    while left < right and not mask[left] > 0.0:
        left += 1
    while left < right and not mask[right - 1] > 0.0:
        right -= 1
    return left, right


@inner
def _fill_gains(mask, area, products, norm, gain):  # type: ignore[no-untyped-def]
    gain[:] = 0.0
    for c in range(len(products)):
        product = products[c]
        for x in range(len(gain)):
            product[x] *= area
            gain[x] += product[x] * product[x]
    for x in range(len(gain)):
        norm[x] *= area
        gain[x] = gain[x] / norm[x] if mask[x] > 0.0 else -1.0


@inner
def _refresh(gain, leaders, first, last):  # type: ignore[no-untyped-def]
    """Find the largest gain, of equal ones the first, of the blocks that hold candidates from first to last."""
    for block in range(first // _BLOCK, (last + _BLOCK - 1) // _BLOCK):
        best = block * _BLOCK
        for i in range(best + 1, min(best + _BLOCK, len(gain))):
            if gain[i] > gain[best]:
                best = i
        leaders[block] = best


@program.entry
def choose(places, square, norm, share, gain, limits, picked):  # type: ignore[no-untyped-def]
    """Pick the largest gain, subtract its share of the error from its neighbours', and again; return the count.

    Places are (x, y, order), sorted by the last: the neighbours of a place lie within one stretch of it. Limits are the
    least gain, the largest overlap, the reach in standard deviations, and the longest reach.
    """
    floor, max_overlap, reach, longest = limits
    widest = square.max()
    leaders = np.empty((len(gain) + _BLOCK - 1) // _BLOCK, np.int64)
    _refresh(gain, leaders, 0, len(gain))
    order = places[:, 2]
    for count in range(len(picked)):
        best = leaders[0]
        for leader in leaders[1:]:
            if gain[leader] > gain[best]:
                best = leader
        if gain[best] <= floor:
            return count
        picked[count] = best
        x, y, middle = places[best, 0], places[best, 1], order[best]
        best_square, best_norm, best_share = square[best], norm[best], share[best].copy()
        far = min(reach * math.sqrt(best_square + widest), longest)
        low = np.searchsorted(order, middle - far)
        high = np.searchsorted(order, middle + far)
        for i in range(low, high):
            dx = places[i, 0] - x
            if abs(dx) > far or gain[i] < 0.0:
                continue
            variance, dy = square[i] + best_square, places[i, 1] - y
            # in a small region Gaussians of all widths are the same: there their norms are what compares
            similarity = max(
                math.sqrt(square[i] * best_square) / variance, math.sqrt(norm[i] * best_norm) / (norm[i] + best_norm)
            )
            overlap = 2.0 * similarity * math.exp(-0.5 * (dx * dx + dy * dy) / variance)
            total = 0.0
            for c in range(len(best_share)):
                share[i, c] -= overlap * best_share[c]
                total += share[i, c] * share[i, c]
            gain[i] = -1.0 if overlap > max_overlap else total
        _refresh(gain, leaders, low, high)
    return len(picked)
