"""The ids of a map's regions, in the order in which the wavefront meets them (docs/format.md)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kcgs.codec.adaptive import AdaptiveSymbol
from kcgs.codec.rangecoder import CodecError, Coder

_MOST_BITS = 24  # of the number of regions
_MASK = [0, 255]  # the ids of many masks
# of the counts of bits between ids of a file, which are often neighbours
_LENGTHS = np.array([8.0, *[1.0] * 16, *[0.125] * 47])


def code_ids(coder: Coder, ids: list[int], limit: int) -> list[int]:
    """Code the ids in the order in which the wavefront meets their regions; a reader gives none."""
    count = _code_regions(coder, len(ids), limit)
    if not coder.fair(ids != list(range(len(ids)))):
        return list(range(count))
    return _code_order(coder, ids, _code_gaps(coder, sorted(ids), count, coder.unbounded))


def code_ids_of_file(coder: Coder, ids: list[int], limit: int) -> list[int]:
    """Do the same in fewer bytes: 0 to R - 1, 0 and 255, or any ids; then whether they rise, and their order."""
    count, length = _code_regions(coder, len(ids), limit), AdaptiveSymbol(_LENGTHS)
    ordered = list(range(count))

    def gap(value: int) -> int:
        bits = int(length.code(coder, 1, np.array([value.bit_length()]))[0])
        return 1 << (bits - 1) | coder.plain(value, bits - 1) if bits else 0

    if coder.fair(sorted(ids) != list(range(len(ids)))):
        masked = count == len(_MASK) and coder.fair(sorted(ids) == _MASK)
        ordered = _MASK if masked else _code_gaps(coder, sorted(ids), count, gap)
    return _code_order(coder, ids, ordered) if coder.fair(ids != sorted(ids)) else ordered


def _code_regions(coder: Coder, regions: int, limit: int) -> int:
    extra = 0
    while coder.fair(regions >= 2 << extra):
        extra += 1
        if extra == _MOST_BITS:
            raise CodecError(f"data must hold at most {limit} regions; got {1 << extra} or more")
    count = 1 << extra | coder.plain(regions, extra)
    if count > limit:
        raise CodecError(f"data must hold at most {limit} regions; got {count}")
    return count


def _code_gaps(coder: Coder, given: list[int], count: int, code: Callable[[int], int]) -> list[int]:
    """Code rising ids, each as its distance from the one before, less 1."""
    ordered, last = [], -1
    for i in range(count):
        last += 1 + code(0 if coder.reads else given[i] - last - 1)
        ordered.append(last)
    if last >= 1 << 63:
        raise CodecError(f"data must hold ids below 2**63; got {last}")
    return ordered


def _code_order(coder: Coder, ids: list[int], ordered: list[int]) -> list[int]:
    """Code the order of the ids; `ordered` has them rising."""
    count = len(ordered)
    left, places, found = Remaining(count), {region: i for i, region in enumerate(sorted(ids))}, []
    for i in range(count):
        rank = coder.number(0 if coder.reads else left.rank(places[ids[i]]), count - i)
        if rank >= count - i:
            raise CodecError(f"data must name one of {count - i} ids that are left; got number {rank}")
        found.append(ordered[left.take(rank)])
    return found


class Remaining:
    """Which of so many things in order are left: a tree of counts, so that millions take seconds."""

    def __init__(self, count: int) -> None:
        self._tree = [i & -i for i in range(count + 1)]

    def rank(self, place: int) -> int:
        """Return how many are left before the one at `place`."""
        total = 0
        while place:
            total += self._tree[place]
            place &= place - 1
        return total

    def take(self, rank: int) -> int:
        """Remove the one that so many are left before; return its place."""
        place, step = 0, 1 << len(self._tree).bit_length()
        while step := step >> 1:
            if place + step >= len(self._tree):
                continue
            if self._tree[place + step] <= rank:
                place += step
                rank -= self._tree[place]
            else:
                self._tree[place + step] -= 1
        return place
