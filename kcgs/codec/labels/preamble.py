"""What comes before the wavefronts: the ids of regions, and the seeds of contours."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.codec.adaptive import AdaptiveBit
from kcgs.codec.rangecoder import CodecError, Coder

_MOST_BITS = 24  # of the number of regions
_SIZES = 8  # contexts of seeds, by how many are in the block


def code_ids(coder: Coder, ids: list[int], limit: int) -> list[int]:
    """Code the ids in the order in which the wavefront meets their regions; a reader gives none."""
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


def code_seeds(coder: Coder, seeds: Any) -> None:
    """Code which entries of `seeds`, (H, W) uint8, are 1, by how many lie in each half of ever smaller blocks.

    A reader sets them.
    """
    count = coder.unbounded(int(np.count_nonzero(seeds)))
    if count > seeds.size:
        raise CodecError(f"data must mark at most {seeds.size} pixels; got {count}")
    extreme = [AdaptiveBit() for _ in range(_SIZES)]
    waiting = [(seeds, count)]
    while waiting:
        block, count = waiting.pop()
        if count == 1:
            place = coder.number(0 if coder.reads else int(block.argmax()), block.size)
            if place >= block.size:
                raise CodecError("data must mark pixels of the map")
            block[place // block.shape[1], place % block.shape[1]] = 1
        elif count == block.size:
            block[:] = 1
        elif count:
            first, second = _halves(block)
            inside = _code_count(coder, first, count, second.size, extreme[min(count.bit_length() - 2, _SIZES - 1)])
            waiting += [(first, inside), (second, count - inside)]


def _halves(block: Any) -> tuple[Any, Any]:
    """Cut across the longer side; the first half is the smaller."""
    height, width = block.shape
    if height >= width:
        return block[: height // 2], block[height // 2 :]
    return block[:, : width // 2], block[:, width // 2 :]


def _code_count(coder: Coder, half: Any, seeds: int, rest: int, extreme: AdaptiveBit) -> int:
    """Code how many of a block's seeds are in its first half: all, none, or some number between."""
    low, high = max(0, seeds - rest), min(seeds, half.size)
    if low == high:
        return low
    count = 0 if coder.reads else int(np.count_nonzero(half))
    if high - low < 2 or extreme.code(coder, count in (low, high)):
        return high if coder.fair(count == high) else low
    count = low + 1 + coder.number(count - low - 1, high - low - 1)
    if count >= high:
        raise CodecError("data must mark pixels of the map")
    return count
