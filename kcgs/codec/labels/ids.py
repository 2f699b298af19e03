"""The ids of regions, in the order in which the wavefront meets them."""

from __future__ import annotations

from kcgs.codec.errors import CodecError
from kcgs.codec.rangecoder import Coder

_MOST_BITS = 24  # of the number of regions


def code_ids(coder: Coder, ids: list[int], limit: int) -> list[int]:
    """Code the ids in the order in which regions are numbered; a reader gives none."""
    extra = 0
    while coder.fair(len(ids) >= 2 << extra):
        extra += 1
        if extra == _MOST_BITS:
            raise CodecError(f"data must hold at most {limit} regions; got {1 << extra} or more")
    count = 1 << extra | coder.plain(len(ids), extra)
    if count > limit:
        raise CodecError(f"data must hold at most {limit} regions; got {count}")
    if not coder.fair(ids != list(range(len(ids)))):
        return list(range(count))
    given, ordered, last = sorted(ids), [], -1
    for i in range(count):
        last += 1 + coder.unbounded(0 if coder.reads else given[i] - last - 1)
        ordered.append(last)
    if last >= 1 << 63:
        raise CodecError(f"data must hold ids below 2**63; got {last}")
    left, places, found = Remaining(count), {region: i for i, region in enumerate(given)}, []
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
