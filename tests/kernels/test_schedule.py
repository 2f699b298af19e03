"""The order of the CPU kernel's tasks: whatever runs beside it, no row reads too early, and sums keep their order."""

from __future__ import annotations

from itertools import combinations

import pytest

from kcgs.kernels.cpu.schedule import ADDS, CLEARS, GATHERS, SUMS, order_tasks

Row = tuple[int, int, int]  # level, image, row


def parents(row: Row, counts: tuple[int, ...]) -> set[Row]:
    """Return the rows of blocks that a row is refined from, and gathers into."""
    level, image, number = row
    if level + 1 == len(counts):
        return set()
    return {(level + 1, image, n) for n in (number // 2, (number + 1) // 2) if n < counts[level + 1]}


@pytest.mark.parametrize("counts", [(1,), (2, 2), (30, 16, 8, 4, 3, 2)])
@pytest.mark.parametrize("kind", [ADDS, GATHERS, ADDS | GATHERS])
def test_order(counts: tuple[int, ...], kind: int) -> None:
    batch = 2
    tasks = order_tasks(counts, batch, kind, 300, 500).tolist()
    starts = [task[0] for task in tasks]
    assert all(start <= k for k, start in enumerate(starts))
    clears = [k for k, task in enumerate(tasks) if task[1] == CLEARS]
    sums = [k for k, task in enumerate(tasks) if task[1] == SUMS]
    assert (len(counts) > 1) == bool(clears) and bool(kind & GATHERS) == bool(sums)
    assert all(starts[k] >= len(tasks) - len(sums) for k in sums)
    for part in (ADDS, GATHERS):
        rows = {tuple(t[2:5]): k for k, t in enumerate(tasks) if t[1] not in (CLEARS, SUMS) and t[1] & part}
        everything = {(level, b, n) for level, count in enumerate(counts) for b in range(batch) for n in range(count)}
        assert set(rows) == (everything if kind & part else set())
        assert all(starts[k] >= len(clears) for k in rows.values())
        for row, k in rows.items():
            for parent in parents(row, counts):
                first, then = (rows[parent], k) if part == ADDS else (k, rows[parent])
                assert first < starts[then]
        if part == GATHERS:
            for one, other in combinations(rows, 2):
                if parents(one, counts) & parents(other, counts):
                    first, then = sorted((one, other), key=lambda row: ((0, 1, 0, 2)[row[2] % 4], row[2]))
                    assert rows[first] < starts[rows[then]]
