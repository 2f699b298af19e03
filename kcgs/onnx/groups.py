"""Groups of tiles, for `plan`: their lists of Gaussians are of similar length, and they are rendered at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .tiles import Tiles

Integers = NDArray[np.int64]

# what one more group costs, in entries of lists: fewer groups are fewer operators, more groups are lists with fewer
# entries that only fill them up. Tune it by the times of `python -m benchmarks decode`
_GROUP_COST = 300
# entries of a group at most: the weights of more, 1 kB of an entry, do not stay in a core's cache
_MOST_ENTRIES = 4096
# the same of a group of blocks of nodes, which is evaluated only when a decoder is loaded
_NODE_GROUP_COST = 4000


class Group(NamedTuple):
    """Tiles, or blocks of nodes, that are rendered together; lists are filled up to the longest with their last."""

    tiles: Integers  # [T], ascending; blocks of nodes are numbered behind the tiles
    lengths: Integers  # [T]
    regions: int  # of a tile, K; 1: nothing is weighed by membership
    narrow: bool  # whether to sum squares in place of a polynomial
    nodes: bool  # whether these are blocks of nodes

    @property
    def longest(self) -> int:
        """Length that all lists are filled up to, L."""
        return max(1, int(self.lengths.max()))


def group_tiles(pairs: Integers, is_narrow: NDArray[np.bool_], tiles: Tiles, num_nodes: int) -> list[Group]:
    """Sort tiles into groups so that little is filled up and there are few groups; those of nodes come last.

    Args:
        pairs: (2, P), Gaussian and tile.
        is_narrow: of every Gaussian.
        tiles: of the scene.
        num_nodes: number of blocks of nodes.
    """
    count = len(tiles.regions)
    lengths = np.bincount(pairs[1], minlength=count + num_nodes)
    narrow_lengths = np.bincount(pairs[1, is_narrow[pairs[0]]], minlength=count + num_nodes)
    kinds: dict[tuple[bool, int, bool], list[tuple[int, int]]] = {}
    for number, length in enumerate(lengths.tolist()):
        regions = len(tiles.regions[number]) if number in tiles.several else 1
        # a tile with several regions needs a list for what comes from coarser grids, too
        if length or (num_nodes and regions > 1):
            # few kinds: numbers of regions rise by powers of two
            kind = (number >= count, 1 << (regions - 1).bit_length(), bool(narrow_lengths[number]))
            kinds.setdefault(kind, []).append((length, number))
    groups = []
    for (nodes, regions, narrow), lists in sorted(kinds.items()):
        for part in _split_by_length(sorted(lists), _NODE_GROUP_COST if nodes else _GROUP_COST):
            numbers, counts = np.array(sorted((number, length) for length, number in part)).T
            groups.append(Group(numbers, counts, regions, narrow, nodes))
    return groups


def _split_by_length(lists: list[tuple[int, int]], group_cost: int) -> list[list[tuple[int, int]]]:
    """Cut the lists, sorted by their lengths, where that costs least: the best cuts by dynamic programming."""
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
