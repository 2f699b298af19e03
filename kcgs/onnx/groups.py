"""Groups of tiles, for `plan`: tiles whose lists of Gaussians have similar lengths are rendered at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .tiles import Tiles

Integers = NDArray[np.int64]

# cost of one more group, in entries of lists: higher: fewer groups and operators; lower: less padding of lists. Tune it
# by the times of `python -m benchmarks decode`
_GROUP_COST = 300
# most entries of a group: the weights of more entries, 1 kB each, do not stay in a core's cache
_MOST_ENTRIES = 4096
# cost of one more group of blocks of nodes, in entries of lists; it is higher since nodes are evaluated only on loading
_NODE_GROUP_COST = 4000


class Group(NamedTuple):
    """Tiles, or blocks of nodes, that are rendered together; lists are padded to the longest by their last Gaussian."""

    tiles: Integers  # [T], ascending; the numbers of blocks of nodes come after those of tiles
    lengths: Integers  # [T], Gaussians in each list
    regions: int  # regions of a tile, K; 1: without memberships
    narrow: bool  # whether to sum squares in place of a polynomial
    nodes: bool  # whether these are blocks of nodes

    @property
    def longest(self) -> int:
        """Length to which all lists are padded, L."""
        return max(1, int(self.lengths.max()))


def group_tiles(pairs: Integers, is_narrow: NDArray[np.bool_], tiles: Tiles, num_nodes: int) -> list[Group]:
    """Sort tiles into few groups with little padding; groups of blocks of nodes come last.

    Args:
        pairs: Gaussian and tile, (2, P).
        is_narrow: flag of every Gaussian.
        tiles: of the scene.
        num_nodes: number of blocks of nodes.
    """
    count = len(tiles.regions)
    lengths = np.bincount(pairs[1], minlength=count + num_nodes)
    narrow_lengths = np.bincount(pairs[1, is_narrow[pairs[0]]], minlength=count + num_nodes)
    kinds: dict[tuple[bool, int, bool], list[tuple[int, int]]] = {}
    for number, length in enumerate(lengths.tolist()):
        regions = len(tiles.regions[number]) if number in tiles.several else 1
        # with coarse grids, a tile with several regions needs a list even if it is empty
        if length or (num_nodes and regions > 1):
            # powers of two as numbers of regions: few kinds
            kind = (number >= count, 1 << (regions - 1).bit_length(), bool(narrow_lengths[number]))
            kinds.setdefault(kind, []).append((length, number))
    groups = []
    for (nodes, regions, narrow), lists in sorted(kinds.items()):
        for part in _split_by_length(sorted(lists), _NODE_GROUP_COST if nodes else _GROUP_COST):
            numbers, counts = np.array(sorted((number, length) for length, number in part)).T
            groups.append(Group(numbers, counts, regions, narrow, nodes))
    return groups


def _split_by_length(lists: list[tuple[int, int]], group_cost: int) -> list[list[tuple[int, int]]]:
    """Cut the lists, sorted by length, into parts of the least total cost, by dynamic programming."""
    lengths, first = np.unique([length for length, _ in lists], return_index=True)
    ends = [*first[1:].tolist(), len(lists)]
    best, cut = [0.0], [0]
    for j, end in enumerate(ends):
        costs = [best[i] + (end - first[i]) * lengths[j] + group_cost for i in range(j + 1)]
        best.append(min(costs))
        cut.append(int(np.argmin(costs)))
    parts, j = [], len(ends)
    while j > 0:
        i = cut[j]
        step = max(1, _MOST_ENTRIES // max(1, int(lengths[j - 1])))
        parts += [lists[k : min(k + step, ends[j - 1])] for k in range(first[i], ends[j - 1], step)]
        j = i
    return parts
