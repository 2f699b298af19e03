"""The ids of a map's regions, in the order in which wavefronts reach them (docs/format.md, "Regions and ids")."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kcgs.codec.adaptive import AdaptiveSymbol
from kcgs.codec.rangecoder import CodecError, Coder

_COUNT_BITS = 24  # bits of the number of regions
_MASK_IDS = [0, 255]  # common ids of masks
# first weights of the counts of bits of distances between ids: 0, 1 to 16, and more
_LENGTH_WEIGHTS = np.array([8.0, *[1.0] * 16, *[0.125] * 47])


def code_ids(coder: Coder, ids: list[int], max_count: int, *, is_file: bool) -> list[int]:
    """Code the ids in the order in which wavefronts reach their regions; a reader's list is empty.

    A file of a label map has a shorter code: whether the ids are 0 to R - 1, 0 and 255, or any others, and whether
    they rise in this order; if not, the order follows.
    """
    count = _code_count(coder, len(ids), max_count)
    if is_file:
        return _code_ids_of_file(coder, ids, count)
    if not coder.fair_bit(ids != list(range(len(ids)))):
        return list(range(count))
    return _code_order(coder, ids, _code_rising(coder, sorted(ids), count, coder.unbounded_number))


def _code_ids_of_file(coder: Coder, ids: list[int], count: int) -> list[int]:
    length, rising = AdaptiveSymbol(_LENGTH_WEIGHTS), list(range(count))

    def code_distance(distance: int) -> int:
        bits = int(length.code(coder, np.array([distance.bit_length()]))[0])
        return 1 << (bits - 1) | coder.plain_bits(distance, bits - 1) if bits else 0

    if coder.fair_bit(sorted(ids) != list(range(len(ids)))):
        is_mask = count == len(_MASK_IDS) and coder.fair_bit(sorted(ids) == _MASK_IDS)
        rising = _MASK_IDS if is_mask else _code_rising(coder, sorted(ids), count, code_distance)
    return _code_order(coder, ids, rising) if coder.fair_bit(ids != sorted(ids)) else rising


def _code_count(coder: Coder, count: int, max_count: int) -> int:
    bits = 0
    while coder.fair_bit(count >= 2 << bits):
        bits += 1
        if bits == _COUNT_BITS:
            raise CodecError(f"data must hold at most {max_count} regions; got {1 << bits} or more")
    count = 1 << bits | coder.plain_bits(count, bits)
    if count > max_count:
        raise CodecError(f"data must hold at most {max_count} regions; got {count}")
    return count


def _code_rising(coder: Coder, ids: list[int], count: int, code_distance: Callable[[int], int]) -> list[int]:
    """Code rising ids, each as its distance from the previous id, minus 1."""
    rising, last = [], -1
    for i in range(count):
        last += 1 + code_distance(0 if coder.is_reader else ids[i] - last - 1)
        rising.append(last)
    if last >= 1 << 63:
        raise CodecError(f"data must hold ids below 2**63; got {last}")
    return rising


def _code_order(coder: Coder, ids: list[int], rising: list[int]) -> list[int]:
    """Code which of the remaining ids each region has; `rising` lists all ids."""
    count = len(rising)
    remaining, positions, order = RankTree(count), {region: i for i, region in enumerate(sorted(ids))}, []
    for i in range(count):
        rank = coder.number(0 if coder.is_reader else remaining.rank(positions[ids[i]]), count - i)
        if rank >= count - i:
            raise CodecError(f"data must name one of the {count - i} remaining ids; got number {rank}")
        order.append(rising[remaining.remove(rank)])
    return order


class RankTree:
    """A Fenwick tree over the positions 0 to count - 1; removing millions one by one takes seconds."""

    def __init__(self, count: int) -> None:
        self._tree = [i & -i for i in range(count + 1)]

    def rank(self, position: int) -> int:
        """Count the remaining positions below this one."""
        rank = 0
        while position:
            rank += self._tree[position]
            position &= position - 1
        return rank

    def remove(self, rank: int) -> int:
        """Remove the position of this rank among the remaining positions, and return it."""
        position, step = 0, 1 << len(self._tree).bit_length()
        while step := step >> 1:
            if position + step >= len(self._tree):
                continue
            if self._tree[position + step] <= rank:
                position += step
                rank -= self._tree[position]
            else:
                self._tree[position + step] -= 1
        return position
