"""Loops over windows of label maps: which regions a window holds, and their membership there."""

from __future__ import annotations

import numpy as np

from kcgs.compiled.program import Program, inner
from kcgs.compiled.tasks import first_task, next_task

program = Program("tables of label maps")

SIDE = 16  # of a tile of `Coverage`: a number, so that the compiler makes vectors of rows


@program.entry
def list_regions(index, places, sides, reaches, num_regions):  # type: ignore[no-untyped-def]
    """Return the number of regions in each window, (T,), and the regions, ascending, one window after the other.

    Windows of `sides` pixels begin at places, (T, 3): map, first row, first column; each is widened by its reach.
    """
    counts, regions = np.empty(len(places), np.int64), np.empty(len(places) + 1, np.int32)
    windows = np.full(num_regions, -1)  # the last that holds a region
    end, (_, height, width) = 0, index.shape
    for t in range(len(places)):
        image, row, col = places[t]
        first, last = end, -1
        for y in range(max(row - reaches[t], 0), min(row + sides[0] + reaches[t], height)):
            for x in range(max(col - reaches[t], 0), min(col + sides[1] + reaches[t], width)):
                region = index[image, y, x]
                if region == last:
                    continue
                last = region
                if windows[region] == t:
                    continue
                windows[region] = t
                if end == len(regions):
                    regions = np.append(regions, np.empty_like(regions))
                k = end
                while k > first and regions[k - 1] > region:
                    regions[k] = regions[k - 1]
                    k -= 1
                regions[k] = region
                end += 1
        counts[t] = end - first
    return counts, regions[:end]


@program.entry
def fill_weights(index, weight, other, other_weight, levels, taps, places, regions, weights, tasks, counters):  # type: ignore[no-untyped-def]
    """Fill the membership of regions, (P,), over windows, (P, h, w), that begin at places, (P, 3).

    Labels are those of `index`, or, where `weight` is not empty, a `weight` of these and an `other_weight` of `other`.
    Row k of taps is half of the blur for pixels of level k, its centre first, then zeros; `levels` is empty where one
    blur is for all. Tasks are ranges of windows.
    """
    height, width = weights.shape[1:]
    reach = taps.shape[1] - 1
    line, rows = np.empty(width + 2 * reach), np.empty((height + 2 * reach, width))
    is_empty, total = np.empty(len(rows), np.bool_), np.empty(width)
    task = first_task(tasks, counters)
    while task >= 0:
        for p in range(tasks[task, 1], tasks[task, 2]):
            image, top, left = places[p]
            for k in range(len(taps)):
                if len(levels) and not _has_level(levels[image], k, top, left, height, width):
                    continue
                half = taps[k, : np.count_nonzero(taps[k])]
                n = len(half) - 1
                down = _sum_inside(half, top, height, index.shape[1])
                across = _sum_inside(half, left, width, index.shape[2])
                for y in range(height + 2 * n):
                    is_empty[y] = True
                    row = top + y - n
                    for x in range(width + 2 * n if 0 <= row < index.shape[1] else 0):
                        place, is_inside = (image, row, left + x - n), 0 <= left + x - n < index.shape[2]
                        line[x] = _part(index, weight, other, other_weight, place, regions[p]) if is_inside else 0.0
                        is_empty[y] &= line[x] == 0.0
                    if not is_empty[y]:
                        _blur(half, line, rows[y])
                for y in range(height):
                    total[:] = 0.0
                    for t in range(2 * n + 1):
                        if not is_empty[y + t]:
                            for x in range(width):
                                total[x] += half[abs(t - n)] * rows[y + t, x]
                    for x in range(width):
                        if not len(levels) or _level(levels[image], top + y, left + x) == k:
                            weights[p, y, x] = total[x] / max(down[y] * across[x], 1e-300)
        task = next_task(tasks, counters)


@program.entry
def fill_planes(index, levels, taps, starts, regions, planes, weights, tasks, counters):  # type: ignore[no-untyped-def]
    """Fill the membership of regions in the tiles of a `Coverage` that several share; otherwise as `fill_weights`.

    Tasks are ranges of tiles.
    """
    _, height, width = index.shape
    rows, cols = (height + SIDE - 1) // SIDE, (width + SIDE - 1) // SIDE
    side = SIDE + 2 * (taps.shape[1] - 1)
    labels, member, blurred = np.empty((side, side), np.int32), np.empty(side), np.empty((side, SIDE))
    is_empty, total = np.empty(side, np.bool_), np.empty((SIDE, SIDE))
    task = first_task(tasks, counters)
    while task >= 0:
        for tile in range(tasks[task, 1], tasks[task, 2]):
            first, end = starts[tile], starts[tile + 1]
            if end - first < 2:
                continue
            image, top, left = tile // (rows * cols), tile // cols % rows * SIDE, tile % cols * SIDE
            if side == SIDE:
                _read_labels(index[image], top, left, side, labels)
                for entry in range(first, end):
                    _mark_members(labels.ravel(), regions[entry], weights[planes[entry]])
                continue
            for k in range(len(taps)):
                if len(levels) and not _has_level(levels[image], k, top, left, SIDE, SIDE):
                    continue
                half = taps[k, : np.count_nonzero(taps[k])]
                n = len(half) - 1
                down, across = _sum_inside(half, top, SIDE, height), _sum_inside(half, left, SIDE, width)
                _read_labels(index[image], top - n, left - n, SIDE + 2 * n, labels)
                for entry in range(first, end):
                    for y in range(SIDE + 2 * n):
                        is_empty[y] = _blur_members(half, labels[y], regions[entry], member, blurred[y])
                    _blur_rows(half, blurred, is_empty, total)
                    _divide(total, down, across)
                    _copy_level(total, levels, k, (image, top, left), weights[planes[entry]])
        task = next_task(tasks, counters)


@inner
def _read_labels(index, top, left, side, labels):  # type: ignore[no-untyped-def]
    """Read a square of an image, -1 beyond it."""
    first, end = max(-left, 0), min(side, index.shape[1] - left)
    for y in range(side):
        labels[y] = -1
        if 0 <= top + y < index.shape[0]:
            labels[y, first:end] = index[top + y, left + first : left + end]


@inner
def _mark_members(labels, region, weights):  # type: ignore[no-untyped-def]
    """Fill the weights of a tile with hard contours."""
    for k in range(SIDE * SIDE):
        weights[k] = np.float32(labels[k] == region)


@inner
def _blur_members(half, labels, region, member, blurred):  # type: ignore[no-untyped-def]
    """Blur what is of a region in a line of a tile's window; return whether nothing is."""
    n = len(half) - 1
    count = 0
    for x in range(SIDE + 2 * n):
        member[x] = labels[x] == region
        count += labels[x] == region
    if count == 0:
        return True
    for x in range(SIDE):
        blurred[x] = 0.0
    for t in range(2 * n + 1):
        tap = half[abs(t - n)]
        for x in range(SIDE):
            blurred[x] += tap * member[x + t]
    return False


@inner
def _blur_rows(half, rows, is_empty, blurred):  # type: ignore[no-untyped-def]
    """Blur the rows of a tile's window to those of the tile."""
    n = len(half) - 1
    for y in range(SIDE):
        total = blurred[y]
        for x in range(SIDE):
            total[x] = 0.0
        for t in range(2 * n + 1):
            if not is_empty[y + t]:
                tap, row = half[abs(t - n)], rows[y + t]
                for x in range(SIDE):
                    total[x] += tap * row[x]


@inner
def _divide(total, down, across):  # type: ignore[no-untyped-def]
    for y in range(SIDE):
        for x in range(SIDE):
            total[y, x] /= max(down[y] * across[x], 1e-300)


@inner
def _copy_level(total, levels, k, place, weights):  # type: ignore[no-untyped-def]
    """Copy the pixels of a level; where there is one, all."""
    image, top, left = place
    for y in range(SIDE):
        for x in range(SIDE):
            if not len(levels) or _level(levels[image], top + y, left + x) == k:
                weights[y * SIDE + x] = total[y, x]


@inner
def _part(index, weight, other, other_weight, place, region):  # type: ignore[no-untyped-def]
    """Return how much of a pixel is of a region."""
    if index[place] == region:
        return weight[place] if len(weight) else 1.0
    return other_weight[place] if len(weight) and other[place] == region else 0.0


@inner
def _blur(half, line, blurred):  # type: ignore[no-untyped-def]
    """Blur a line to the places where the whole window lies in it."""
    n = len(half) - 1
    blurred[:] = 0.0
    for t in range(2 * n + 1):
        for x in range(len(blurred)):
            blurred[x] += half[abs(t - n)] * line[x + t]


@inner
def _sum_inside(half, first, count, length):  # type: ignore[no-untyped-def]
    """Sum the taps that lie inside of an axis, around each of `count` pixels."""
    line = np.zeros(count + 2 * len(half) - 2)
    begin = len(half) - 1 - first
    line[max(begin, 0) : max(begin + length, 0)] = 1.0
    sums = np.empty(count)
    _blur(half, line, sums)
    return sums


@inner
def _level(levels, row, col):  # type: ignore[no-untyped-def]
    """Return the level of a pixel; beyond the image the border repeats."""
    return levels[min(max(row, 0), levels.shape[0] - 1), min(max(col, 0), levels.shape[1] - 1)]


@inner
def _has_level(levels, k, top, left, height, width):  # type: ignore[no-untyped-def]
    for y in range(top, top + height):
        for x in range(left, left + width):
            if _level(levels, y, x) == k:
                return True
    return False
