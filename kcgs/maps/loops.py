"""Loops over label maps: which regions a tile or a window holds, and their membership there.

A table takes a third to a fifth of the time of torch operations.
"""

from __future__ import annotations

import numpy as np

from kcgs.compiled.program import Program, inner
from kcgs.compiled.tasks import END_ROW, FIRST_ROW, first_task, next_task

from .tile import TILE

program = Program("tables of label maps")


@program.entry
def number_regions(labels, limit, index):
    """Fill each label's position among the sorted ids, and return the ids; none if a label is outside [0, limit).

    Labels, (N,), and index, (N,), are flat.
    """
    positions = np.full(limit, -1, np.int32)
    last, largest = -1, 0
    for label in labels:
        if label == last:
            continue
        if label < 0 or label >= limit:
            return np.empty(0, np.int64)
        positions[label] = 0
        last, largest = label, max(largest, label)
    ids = np.flatnonzero(positions[: largest + 1] == 0)
    for k in range(len(ids)):
        positions[ids[k]] = k
    last, position = -1, 0
    for n in range(len(labels)):
        if labels[n] != last:
            last = labels[n]
            position = positions[last]
        index[n] = position
    return ids


@program.entry
def find_positions(region_ids, ids, limit, positions):
    """Fill the position of each id among sorted `ids`, -1 where it is not one of them; all are flat.

    If all `ids` are below the limit, a table replaces the search.
    """
    largest = ids[-1]
    if largest < limit:
        table = np.full(largest + 1, -1, np.int32)
        for k in range(len(ids)):
            table[ids[k]] = k
        for n in range(len(region_ids)):
            positions[n] = table[region_ids[n]] if 0 <= region_ids[n] <= largest else -1
        return
    for n in range(len(region_ids)):
        k = np.searchsorted(ids, region_ids[n])
        positions[n] = k if k < len(ids) and ids[k] == region_ids[n] else -1


@program.entry
def list_regions(index, width_index, reaches, num_regions):
    """Return the number of regions of each tile, (T,), and the regions, ascending, one tile after the other.

    A region belongs to a tile if it has a pixel within the reach of the tile's widest contour. `reaches` has the reach
    of each width; `width_index` is empty where there is one width.
    """
    maps, height, width = index.shape
    rows, cols = (height + TILE - 1) // TILE, (width + TILE - 1) // TILE
    counts, regions = np.empty(maps * rows * cols, np.int64), np.empty(maps * rows * cols + 1, np.int32)
    tiles = np.full(num_regions, -1)  # last tile that was found to hold each region
    end = 0
    for t in range(len(counts)):
        image, top, left = t // (rows * cols), t // cols % rows * TILE, t % cols * TILE
        reach = reaches[_widest(width_index[image], top, left) if len(width_index) else 0]
        first, last = end, -1
        left, right = max(left - reach, 0), min(left + TILE + reach, width)
        for y in range(max(top - reach, 0), min(top + TILE + reach, height)):
            for x in range(left, right):
                region = index[image, y, x]
                if region == last:
                    continue
                last = region
                if tiles[region] == t:
                    continue
                tiles[region] = t
                regions = _insert(regions, first, end, region)
                end += 1
        counts[t] = end - first
    return counts, regions[:end]


@program.entry
def list_window_regions(starts, regions, shape, places, span, num_regions):
    """Return number and regions of windows, as `list_regions` does of tiles: the regions of the tiles they touch.

    Args:
        starts: of a `MapTable`.
        regions: of the same table.
        shape: maps, height and width.
        places: (T, 3), map, first row and first column; rows and columns may lie beyond the image.
        span: height and width of a window.
        num_regions: of the map.
    """
    rows, cols = (shape[1] + TILE - 1) // TILE, (shape[2] + TILE - 1) // TILE
    counts, entries = np.empty(len(places), np.int64), np.empty(len(places) + 1, np.int32)
    windows = np.full(num_regions, -1)
    end = 0
    for t in range(len(places)):
        image, top, left = places[t]
        first = end
        for row in range(max(top // TILE, 0), min((top + span[0] - 1) // TILE + 1, rows)):
            for col in range(max(left // TILE, 0), min((left + span[1] - 1) // TILE + 1, cols)):
                tile = (image * rows + row) * cols + col
                for entry in range(starts[tile], starts[tile + 1]):
                    if windows[regions[entry]] != t:
                        windows[regions[entry]] = t
                        entries = _insert(entries, first, end, regions[entry])
                        end += 1
        counts[t] = end - first
    return counts, entries[:end]


@inner
def _insert(values, first, end, value):
    """Insert into values[first:end], which ascend; return the array, or a larger one."""
    if end == len(values):
        values = np.append(values, np.empty_like(values))
    k = end
    while k > first and values[k - 1] > value:
        values[k] = values[k - 1]
        k -= 1
    values[k] = value
    return values


@program.entry
def cut_windows(tiles, shape, places, members, windows, tasks, counters):
    """Fill the membership of regions, (P,), over windows, (P, h, w), at places, (P, 3), out of a `MapTable`.

    `tiles` has its `TILE_FIELDS`; `shape` is that of `list_window_regions`; membership is 0 beyond the tiles. Tasks are
    ranges of windows.
    """
    starts, regions, planes, weights = tiles
    rows, cols = (shape[1] + TILE - 1) // TILE, (shape[2] + TILE - 1) // TILE
    height, width = windows.shape[1:]
    task = first_task(tasks, counters)
    while task >= 0:
        for p in range(tasks[task, FIRST_ROW], tasks[task, END_ROW]):
            image, top, left = places[p]
            windows[p] = 0.0
            for row in range(max(top // TILE, 0), min((top + height - 1) // TILE + 1, rows)):
                for col in range(max(left // TILE, 0), min((left + width - 1) // TILE + 1, cols)):
                    tile = (image * rows + row) * cols + col
                    for entry in range(starts[tile], starts[tile + 1]):
                        if regions[entry] == members[p]:
                            _copy_plane(planes[entry], weights, row * TILE - top, col * TILE - left, windows[p])
        task = next_task(tasks, counters, task)


@inner
def _copy_plane(plane, weights, top, left, window):
    """Copy the part of a tile that lies in a window."""
    height, width = window.shape
    for y in range(max(top, 0), min(top + TILE, height)):
        for x in range(max(left, 0), min(left + TILE, width)):
            window[y, x] = weights[plane, (y - top) * TILE + x - left] if plane >= 0 else 1.0


@program.entry
def fill_planes(index, smooth, blurs, tiles, tasks, counters):
    """Fill the membership of regions in the tiles of a `MapTable` that hold several regions.

    `tiles` has its `TILE_FIELDS`, of which `weights` is filled. `smooth` has the arrays of `SmoothLabels`; if they are
    not empty, they divide each pixel between its label in `index` and a neighbour's. `blurs` has the width of each
    pixel, empty where there is one width, and taps. Row k of taps is half of the blur for pixels of width k, its centre
    first, then zeros. Tasks are ranges of tiles.
    """
    (width_index, taps), (starts, regions, planes, weights) = blurs, tiles
    _, height, width = index.shape
    rows, cols = (height + TILE - 1) // TILE, (width + TILE - 1) // TILE
    side = TILE + 2 * (taps.shape[1] - 1)
    labels, others = np.empty((side, side), np.int32), np.empty((side, side), np.int32)
    own_shares, other_shares = np.empty((side, side)), np.empty((side, side))
    member, blurred = np.empty(side), np.empty((side, TILE))
    is_empty, total = np.empty(side, np.bool_), np.empty((TILE, TILE))
    is_smooth = len(smooth[0]) > 0
    task = first_task(tasks, counters)
    while task >= 0:
        for tile in range(tasks[task, FIRST_ROW], tasks[task, END_ROW]):
            first, end = starts[tile], starts[tile + 1]
            if end - first < 2:
                continue
            image, top, left = tile // (rows * cols), tile // cols % rows * TILE, tile % cols * TILE
            if side == TILE:
                _read(index[image], top, left, side, -1, labels)
                for entry in range(first, end):
                    _mark_members(labels.ravel(), regions[entry], weights[planes[entry]])
                continue
            for k in range(len(taps)):
                if len(width_index) and not _has_width(width_index[image], k, top, left):
                    continue
                half = taps[k, : np.count_nonzero(taps[k])]
                n = len(half) - 1
                down, across = _sum_inside(half, top, height), _sum_inside(half, left, width)
                _read(index[image], top - n, left - n, TILE + 2 * n, -1, labels)
                if is_smooth:
                    _read(smooth[0][image], top - n, left - n, TILE + 2 * n, 0, own_shares)
                    _read(smooth[1][image], top - n, left - n, TILE + 2 * n, -1, others)
                    _read(smooth[2][image], top - n, left - n, TILE + 2 * n, 0, other_shares)
                for entry in range(first, end):
                    for y in range(TILE + 2 * n):
                        if is_smooth:
                            _share(labels[y], own_shares[y], others[y], other_shares[y], regions[entry], member)
                            count = np.count_nonzero(member)
                        else:
                            count = _find_members(labels[y], regions[entry], member)
                        is_empty[y] = count == 0
                        if count > 0:
                            _blur(half, member, blurred[y])
                    _blur_rows(half, blurred, is_empty, total)
                    _divide(total, down, across)
                    _copy_pixels(total, width_index, k, (image, top, left), weights[planes[entry]])
        task = next_task(tasks, counters, task)


@inner
def _read(image, top, left, side, outside, square):
    """Read a square of an image; beyond the image it has the value `outside`."""
    first, end = max(-left, 0), min(side, image.shape[1] - left)
    for y in range(side):
        square[y] = outside
        if 0 <= top + y < image.shape[0]:
            square[y, first:end] = image[top + y, left + first : left + end]


@inner
def _mark_members(labels, region, weights):
    """Fill the weights of a tile with hard contours."""
    for k in range(TILE * TILE):
        weights[k] = labels[k] == region


@inner
def _find_members(labels, region, member):
    """Mark the pixels of a line that belong to a region; return their number."""
    count = 0
    for x in range(len(member)):
        member[x] = labels[x] == region
        count += labels[x] == region
    return count


@inner
def _share(labels, own_shares, others, other_shares, region, member):
    """Fill the share of each pixel of a line that belongs to a region."""
    for x in range(len(member)):
        other = other_shares[x] if others[x] == region else 0.0
        member[x] = own_shares[x] if labels[x] == region else other


@inner
def _blur(half, line, blurred):
    """Blur a line to the pixels of a tile."""
    n = len(half) - 1
    for x in range(TILE):
        blurred[x] = 0.0
    for t in range(2 * n + 1):
        tap = half[abs(t - n)]
        for x in range(TILE):
            blurred[x] += tap * line[x + t]


@inner
def _blur_rows(half, rows, is_empty, blurred):
    """Blur the rows of a tile's window to the rows of the tile."""
    n = len(half) - 1
    for y in range(TILE):
        total = blurred[y]
        for x in range(TILE):
            total[x] = 0.0
        for t in range(2 * n + 1):
            if not is_empty[y + t]:
                tap, row = half[abs(t - n)], rows[y + t]
                for x in range(TILE):
                    total[x] += tap * row[x]


@inner
def _divide(total, down, across):
    for y in range(TILE):
        for x in range(TILE):
            total[y, x] /= max(down[y] * across[x], 1e-300)


@inner
def _copy_pixels(total, width_index, k, place, weights):
    """Copy the pixels of width k; all pixels where there is one width."""
    image, top, left = place
    for y in range(TILE):
        for x in range(TILE):
            if not len(width_index) or _width(width_index[image], top + y, left + x) == k:
                weights[y * TILE + x] = total[y, x]


@inner
def _sum_inside(half, first, length):
    """Return for each pixel of a tile the sum of the taps around it that lie within the image along an axis."""
    line = np.zeros(TILE + 2 * len(half) - 2)
    begin = len(half) - 1 - first
    line[max(begin, 0) : max(begin + length, 0)] = 1.0
    sums = np.empty(TILE)
    _blur(half, line, sums)
    return sums


@inner
def _width(width_index, row, col):
    """Return the width of a pixel; beyond the image the border repeats."""
    return width_index[min(max(row, 0), width_index.shape[0] - 1), min(max(col, 0), width_index.shape[1] - 1)]


@inner
def _has_width(width_index, k, top, left):
    for y in range(top, top + TILE):
        for x in range(left, left + TILE):
            if _width(width_index, y, x) == k:
                return True
    return False


@inner
def _widest(width_index, top, left):
    """Return the largest width of a tile."""
    widest = 0
    for y in range(top, min(top + TILE, width_index.shape[0])):
        for x in range(left, min(left + TILE, width_index.shape[1])):
            widest = max(widest, width_index[y, x])
    return widest
