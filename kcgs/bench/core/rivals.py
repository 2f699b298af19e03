"""Files of another method of about as many bytes as ours: N is searched, fit by fit."""

from __future__ import annotations

import math
from collections.abc import Iterable

from .cases import Case, Method
from .jobs import Place
from .store import Row, Store

# what files of about as many bytes are aimed at, may have, and how many fits that may take
_ABOVE, _NEAR, _TRIES = 1.03, 1.06, 4


def approach(
    store: Store, cases: Iterable[Case], ours: Method, other: Method, place: Place, deadline: float | None = None
) -> list[str]:
    """Make files of another method of about as many bytes as ours.

    Returns:
        What failed; what could not be made is not tried again.
    """
    cases = list(cases)
    for _ in range(_TRIES):
        failed = store.obtain(rivals(store, cases, ours, other), place, deadline)
        if failed:
            return failed
    return []


def rivals(store: Store, cases: Iterable[Case], ours: Method, other: Method) -> list[Case]:
    """Return fits of the other method with about the Gaussians that the bytes of ours buy.

    They are found one after another: those that are made already, and of each at most one that is not.
    """
    cases = list(dict.fromkeys(cases))
    found = []
    others = {(case.image, case.n, case.seed): case for case in cases if case.method == other}
    for case in cases:
        beside = others.get((case.image, case.n, case.seed))
        if case.method == ours and beside is not None:
            row, first = store.row(case), store.row(beside)
            if row is not None and first is not None:
                found += _approach(store, beside, first, row.bytes)
    return found


def near(rows: Iterable[Row], row: Row, method: str) -> Row | None:
    """Return the file of another method with as many bytes as a row's, or little more, the nearest one."""
    found = [r for r in rows if (r.image, r.seed, r.method) == (row.image, row.seed, method)]
    return min((r for r in found if row.bytes <= r.bytes <= _NEAR * row.bytes), key=lambda r: r.bytes, default=None)


def _approach(store: Store, first: Case, row: Row, size: int) -> list[Case]:
    """Return fits ever nearer to `size` bytes, until one has as many, or little more, or is not made yet."""
    made, found = {row.n: row.bytes}, list[Case]()
    while len(found) < _TRIES and not any(size <= count <= _NEAR * size for count in made.values()):
        case = first._replace(n=_guess(made, _ABOVE * size))
        if case.n in made:
            break
        found.append(case)
        reached = store.row(case)
        if reached is None:
            break
        made[case.n] = reached.bytes
    return found


def _guess(made: dict[int, int], size: float) -> int:
    """Return the N of so many bytes, by the line through the two nearest files, or through the only one and nothing."""
    (n, count), (other, beside) = sorted([*made.items(), (0, 0)], key=lambda point: abs(point[1] - size))[:2]
    return n + 1 if count == beside else max(1, 1 + math.ceil(n + (size - count) * (n - other) / (count - beside)))
