"""A label map that is predicted from the last one, by an affine motion of each region (docs/format.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.kernels.compiled import Program, inner

UNIT = 1 << 16
"""What a pixel, and a factor of 1, are in the numbers of a motion."""
MOST_FACTOR, MOST_SHIFT, _MOST_SIDE = 1 << 20, 1 << 37, 1 << 20

program = Program("label motion", __name__, __file__, "moving.py")


def still_motions(num_regions: int) -> Any:
    """Return motions [num_regions, 6] int64 that move nothing."""
    return np.tile(np.array([UNIT, 0, 0, 0, UNIT, 0], np.int64), (num_regions, 1))


def move_labels(index: Any, motions: Any) -> Any:
    """Predict a label map from the last one and a motion of each region, in integers: the same map on every machine.

    A motion says where a pixel comes from. It has the numbers (a, b, c, d, e, f), each in 1/65536: the point (x, y) of
    the new map was at (a x + b y + c, d x + e y + f) in the last one, in pixels, and pixel (j, i) is its centre
    (j + 1/2, i + 1/2). A pixel belongs to the region whose motion leads to a pixel of its own in the last map; beyond
    its sides, to the nearest one. Of several such regions the one with the smallest area in the last map comes first,
    of equal areas the higher position. Runs of pixels in a row that no region has take the label of the pixel at their
    left or right, whichever region is larger: what is uncovered lies behind. Rows that no region has take those above.

    Args:
        index: :math:`(H, W)` int32, positions of regions, 0 to R - 1; sides of at most 2**20.
        motions: :math:`(R, 6)` integers; a, b, d and e within 2**20 (a factor of 16), c and f within 2**37 (2,097,152
            pixels), with either sign. All sums stay below 2**44.

    Returns:
        :math:`(H, W)` int32.

    Raises:
        ValueError: an argument is out of these ranges.

    Example:
        >>> index = np.array([[0, 1, 0, 0, 0]], np.int32)
        >>> motions = still_motions(2)
        >>> motions[1, 2] = -2 * UNIT
        >>> move_labels(index, motions).tolist()
        [[0, 0, 0, 1, 0]]
    """
    index, motions = np.asarray(index), np.asarray(motions)
    if index.ndim != 2 or index.dtype != np.int32 or not 1 <= min(index.shape) <= max(index.shape) <= _MOST_SIDE:
        raise ValueError(
            f"index must be (H, W) int32 with sides of 1 to {_MOST_SIDE}; got {index.shape} of {index.dtype}"
        )
    if motions.ndim != 2 or motions.shape[1] != 6 or not np.issubdtype(motions.dtype, np.integer) or not len(motions):
        raise ValueError(f"motions must be (R, 6) integers; got {motions.shape} of {motions.dtype}")
    low, high = int(index.min()), int(index.max())
    if low < 0 or high >= len(motions):
        raise ValueError(f"index must hold 0 to {len(motions) - 1}, one motion for each; got {low} to {high}")
    for name, columns, most in (("factors", [0, 1, 3, 4], MOST_FACTOR), ("shifts", [2, 5], MOST_SHIFT)):
        if (motions[:, columns] > most).any() or (motions[:, columns] < -most).any():
            raise ValueError(f"{name} of motions must be within {most}; got {motions[:, columns].tolist()}")
    program.ready()
    return move(np.ascontiguousarray(index), motions.astype(np.int64))


@inner
def _measure(index, regions):  # type: ignore[no-untyped-def]
    """Return the area of each region, and its first and last column and row."""
    height, width = index.shape
    areas, boxes = np.zeros(regions, np.int64), np.empty((regions, 4), np.int64)
    boxes[:, 0], boxes[:, 1], boxes[:, 2], boxes[:, 3] = width, -1, height, -1
    for i in range(height):
        for j in range(width):
            box = boxes[index[i, j]]
            areas[index[i, j]] += 1
            box[0], box[1], box[2], box[3] = min(box[0], j), max(box[1], j), min(box[2], i), max(box[3], i)
    return areas, boxes


@inner
def _range(start, step, first, last, size):  # type: ignore[no-untyped-def]
    """Return the range of j with first <= (start + j step) >> 17 <= last; at the map's sides it has no end."""
    far = np.int64(1) << 62
    least = start - (first << 17) if first > 0 else far
    most = ((last + 1) << 17) - 1 - start if last < size - 1 else far
    if step == 0:
        return (0, far) if least >= 0 and most >= 0 else (0, 0)
    if step > 0:
        return -(least // step), most // step + 1
    return -(most // -step), least // -step + 1


@inner
def _claim(index, region, motion, box, moved):  # type: ignore[no-untyped-def]
    """Give a region the pixels that its motion leads from to one of its own."""
    height, width = index.shape
    a, b, c, d, e, f = motion
    for i in range(height):
        # twice the source of the row's first centre; 2 a and 2 d more for each pixel
        x, y = a + b * (2 * i + 1) + 2 * c, d + e * (2 * i + 1) + 2 * f
        low, high = _range(x, 2 * a, box[0], box[1], width)
        least, most = _range(y, 2 * d, box[2], box[3], height)
        low, high = max(low, least, 0), min(high, most, width)
        x, y = x + low * 2 * a, y + low * 2 * d
        for j in range(low, high):
            if index[min(max(y >> 17, 0), height - 1), min(max(x >> 17, 0), width - 1)] == region:
                moved[i, j] = region
            x += 2 * a
            y += 2 * d


@inner
def _fill_row(row, rank):  # type: ignore[no-untyped-def]
    """Fill what no region has from the left or the right, by the larger region; tell whether the row has any."""
    j, width = 0, len(row)
    while j < width:
        if row[j] >= 0:
            j += 1
            continue
        end = j
        while end < width and row[end] < 0:
            end += 1
        if end - j == width:
            return False
        label = row[j - 1] if j > 0 else row[end]
        if end < width and rank[row[end]] < rank[label]:
            label = row[end]
        row[j:end] = label
        j = end
    return True


@program.entry
def move(index, motions):  # type: ignore[no-untyped-def]
    """Move the regions from the largest to the smallest, each over those before, then fill what none has."""
    areas, boxes = _measure(index, len(motions))
    order = np.argsort(-areas, kind="mergesort")
    rank = np.empty(len(motions), np.int32)
    moved = np.full(index.shape, -1, np.int32)
    for n in range(len(motions)):
        region = order[n]
        rank[region] = n
        if areas[region] > 0:
            _claim(index, region, motions[region], boxes[region], moved)
    known = -1
    for i in range(len(moved)):
        if _fill_row(moved[i], rank):
            moved[: i if known < 0 else 0] = moved[i]
            known = i
        elif known >= 0:
            moved[i] = moved[known]
    if known < 0:
        moved[:] = order[0]
    return moved


@program.part
def moves() -> None:
    """Compile the motion of a map."""
    move(np.zeros((2, 2), np.int32), still_motions(2))
