"""The tasks of the CPU kernel: nodes to clear, rows of blocks, and ranges of Gaussians whose terms are summed.

Tasks that add begin with the coarsest nodes, which finer rows read; tasks that gather end with the coarsest nodes. Rows
that gather into the same blocks of the coarser grid have a fixed order: the even row, then the row whose number modulo
4 is 1, then 3. A task waits for the rows that it needs and for all tasks listed before them, so that no thread waits
for a whole level.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

from kcgs.compiled.tasks import chunks

# columns of a task after its START; a range has its first at FIRST_FIELD, and its last + 1 after that
KIND = 1  # ADDS, GATHERS, both; SUMS, CLEARS
LEVEL_FIELD = 2
FIRST_FIELD = 2
IMAGE = 3
ROW = 4  # of blocks, in its image and grid

SUMS = 0
ADDS = 1
GATHERS = 2
CLEARS = 4

# least blocks of nodes per task that clears, least Gaussians per task that sums, and most tasks of either kind
_CLEAR_SIZE = 64
_SUM_SIZE = 128
_MOST_RANGES = 64


@functools.lru_cache(maxsize=32)
def order_tasks(counts: tuple[int, ...], batch: int, kind: int, num_blocks: int, num_gaussians: int) -> Any:
    """Return the tasks, (T, 5) int64.

    Args:
        counts: rows of blocks per image on each level, the pixels first.
        batch: number of images.
        kind: ADDS, GATHERS, or both at once.
        num_blocks: blocks of nodes, all of which are cleared.
        num_gaussians: Gaussians whose terms are summed after all rows have gathered.
    """
    cleared = _ranges(CLEARS, num_blocks if len(counts) > 1 else 0, _CLEAR_SIZE)
    rows = _RowTasks(batch, len(cleared))
    top = len(counts) - 1
    if kind & ADDS:
        for level in range(top, 0, -1):
            rows.add(ADDS, level, range(counts[level]))
    if kind & GATHERS:
        for level in range(top + 1):
            for first, step in ((0, 2), (1, 4), (3, 4)):
                rows.add(kind if level == 0 else GATHERS, level, range(first, counts[level], step))
    else:
        rows.add(ADDS, 0, range(counts[0]))
    sums = _ranges(SUMS, num_gaussians if kind & GATHERS else 0, _SUM_SIZE)
    sums = [[len(cleared) + len(rows.tasks), *row] for row in sums]
    return np.array([[0, *row] for row in cleared] + rows.tasks + sums, np.int64).reshape(-1, 5)


class _RowTasks:
    """Tasks of rows in their order, each with the number of tasks that must be done before it."""

    def __init__(self, batch: int, cleared: int) -> None:
        self._batch, self._cleared = batch, cleared
        self._ends: dict[tuple[int, int, int, int], int] = {}  # number of tasks up to and including a row's
        self.tasks: list[list[int]] = []

    def add(self, kind: int, level: int, rows: range) -> None:
        """Append rows of a level, of all images."""
        for image in range(self._batch):
            for row in rows:
                needed = [self._ends.get((part, grid, image, n), 0) for part, grid, n in _needs(kind, level, row)]
                self.tasks.append([max(needed, default=0) or self._cleared, kind, level, image, row])
                for part in (ADDS, GATHERS):
                    if kind & part:
                        self._ends[part, level, image, row] = self._cleared + len(self.tasks)


def _needs(kind: int, level: int, row: int) -> Iterator[tuple[int, int, int]]:
    """Yield kind, level and number of the rows that must be done before a row; some of them do not exist."""
    if kind & ADDS:  # its parents
        yield from ((ADDS, level + 1, row // 2), (ADDS, level + 1, (row + 1) // 2))
    if kind & GATHERS:  # its children, and earlier rows with the same parents
        yield from ((GATHERS, level - 1, child) for child in (2 * row - 1, 2 * row, 2 * row + 1))
        if row % 2 == 1:
            yield from ((GATHERS, level, row - 1), (GATHERS, level, row + 1))
        if row % 4 == 3:
            yield from ((GATHERS, level, row - 2), (GATHERS, level, row + 2))


def _ranges(kind: int, count: int, size: int) -> list[list[int]]:
    return [[kind, first, end, 0] for first, end in chunks(count, size, _MOST_RANGES).tolist() if first < end]
