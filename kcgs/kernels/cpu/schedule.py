"""Which rows of tiles may be visited at once, in which order, and the threads that do so."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from ..threads import num_threads

# in place of a level: the blocks of nodes are refined
REFINEMENT = -1
# sections of pixels, which come first
_PIXEL_SECTIONS = 3
# entries of the lists up to which the calling thread does all: waking another costs as much
_SERIAL_ENTRIES = 200


class Schedule(NamedTuple):
    """Rows of tiles in the order of the backward; the forward's is the reverse.

    First come the rows of pixels by their number modulo 4: 0 and 2, then 1, then 3; those of a section share no blocks
    of nodes. Then comes the refinement, then the rows of nodes.
    """

    rows: Any  # [R, 4] int64: number, level (or REFINEMENT), image, row in its grid
    starts: list[int]  # of the five sections, and the end


@functools.lru_cache(maxsize=8)
def order_rows(counts: tuple[int, ...], batch: int) -> Schedule:
    """Return the schedule of `batch` images with so many rows of tiles on each level."""
    by_level = [
        np.column_stack([np.arange(batch * count) + batch * sum(counts[:level]), np.full(batch * count, level),
                         np.repeat(np.arange(batch), count), np.tile(np.arange(count), batch)])
        for level, count in enumerate(counts)
    ]  # fmt: skip
    remainder = by_level[0][:, 3] % 4
    sections = [by_level[0][members] for members in (remainder % 2 == 0, remainder == 1, remainder == 3)]
    nodes = np.concatenate([np.empty((0, 4), np.int64), *by_level[1:]])
    sections += [np.array([[0, REFINEMENT, 0, 0]]), nodes]
    return Schedule(np.concatenate(sections), np.cumsum([0, *map(len, sections)]).tolist())


def run(visit: Callable[[Any], None], schedule: Schedule, entries: int, has_nodes: bool, reverse: bool) -> None:
    """Call visit(rows) for all rows, shared among threads, the caller's among them, section by section."""
    starts = schedule.starts if has_nodes else schedule.starts[: _PIXEL_SECTIONS + 1]
    rows = schedule.rows[: starts[-1]]
    threads = min(num_threads(), len(rows))
    if threads < 2 or entries < _SERIAL_ENTRIES:
        visit(rows[::-1].copy() if reverse else rows)
        return
    # without nodes, sections share nothing
    sections = [rows[first:last] for first, last in itertools.pairwise(starts)] if has_nodes else [rows]
    for section in reversed(sections) if reverse else sections:
        if len(section):
            part, *others = (section[t::threads].copy() for t in range(min(threads, len(section))))
            futures = [_pool(os.getpid(), num_threads() - 1).submit(visit, other) for other in others]
            visit(part)
            for future in futures:
                future.result()


@functools.cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    # by process, since threads do not survive a fork
    return ThreadPoolExecutor(threads, thread_name_prefix="kcgs")
