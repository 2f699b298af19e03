"""The tasks of the CPU kernel: rows of blocks, and ranges of Gaussians whose terms are summed, in phases."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from kcgs.compiled.tasks import chunks, phases

# columns of a task behind its START; or, of a sum, the first Gaussian and the last + 1 in FIRST_FIELD
KIND = 1  # ADDS, GATHERS, both; 0: a sum
LEVEL_FIELD = 2
FIRST_FIELD = 2
IMAGE = 3
ROW = 4  # of blocks, in its image and grid

ADDS = 1
GATHERS = 2

# Gaussians that one task sums up, at least, and tasks at most
_SUM_SIZE = 512
_MOST_SUMS = 64


@functools.lru_cache(maxsize=32)
def order_tasks(counts: tuple[int, ...], batch: int, kind: int, num_gaussians: int) -> Any:
    """Return the tasks of `batch` images with so many rows of blocks on each level; the levels above the pixels.

    What adds begins with the coarsest nodes, which the finer ones read. What gathers ends there: rows that add to the
    same blocks of the coarser grid are in different phases, by their number modulo 4: 0 and 2, then 1, then 3.
    """
    parts = []
    if kind & ADDS:
        parts += [_rows(ADDS, level, counts[level], batch) for level in reversed(range(1, len(counts)))]
    pixels = _rows(kind, 0, counts[0], batch)
    if kind & GATHERS:
        for rows in (pixels, *(_rows(GATHERS, level, counts[level], batch) for level in range(1, len(counts)))):
            remainder = rows[:, 3] % 4
            parts += [rows[members] for members in (remainder % 2 == 0, remainder == 1, remainder == 3)]
        sums = chunks(num_gaussians, _SUM_SIZE, _MOST_SUMS)
        parts.append(np.column_stack([np.zeros(len(sums), np.int64), sums, np.zeros(len(sums), np.int64)]))
    else:
        parts.append(pixels)
    return phases(*parts)


def _rows(kind: int, level: int, count: int, batch: int) -> Any:
    return np.column_stack([
        np.full(batch * count, kind), np.full(batch * count, level),
        np.repeat(np.arange(batch), count), np.tile(np.arange(count), batch),
    ])  # fmt: skip
