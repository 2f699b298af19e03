"""Tables for `entries`: the group and the place in it of each tile, and the blocks of nodes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .graph import INT32, Graph, Value
from .packing import pack_flags, pack_integers
from .plan import DecoderPlan, NodeBlocks


class Slots(NamedTuple):
    """The places of n tiles and blocks of nodes in groups, int32."""

    group: Value  # (n,), number of the group; for tiles without Gaussians the count of groups
    slot: Value  # (n,), place among the tiles of the group
    rank: Value  # (n,), place among the tiles of all groups
    tiles: list[Value]  # of each group, (T,)


def make_slots(g: Graph, plan: DecoderPlan) -> Slots:
    """Sort tiles and blocks of nodes by group."""
    groups = plan.groups
    group_of = np.full(plan.num_blocks, len(groups))
    for number, members in enumerate(groups):
        group_of[members.tiles] = number
    group = pack_integers(g, group_of)
    order = g.argsort(group, [plan.num_blocks]).astype(INT32)
    rank = g.argsort(order, [plan.num_blocks]).astype(INT32)
    starts = np.cumsum([0, *(len(members.tiles) for members in groups)])
    slot = rank - g.constant(starts.astype(np.int32))[group]
    tiles = g.split(g.Slice(order, [0], starts[-1:]), np.diff(starts).tolist()) if groups else []
    return Slots(group, slot, rank, tiles)


class NodeTable(NamedTuple):
    """The n blocks of nodes, int32, and a table from places to blocks."""

    nodes: NodeBlocks
    block: Value  # block at each level, region, row and column; if there is none, n, a block of zeros
    level: Value  # (n,), from 0 for the finest grid
    region: Value  # (n,)
    row: Value  # (n,)
    col: Value  # (n,)


def make_node_table(g: Graph, nodes: NodeBlocks) -> NodeTable:
    """Store the blocks of nodes as flags of places, and unfold them."""
    count = len(nodes.place)
    flags = np.zeros(nodes.shape, np.bool_)
    flags[tuple(nodes.place.T)] = True
    present = pack_flags(g, flags.ravel())
    number = g.CumSum(present, 0) - 1
    block = g.Where(g.Equal(present, np.int32(1)), number, np.int32(count))
    place = g.argsort(present, [count], largest=1).astype(INT32)
    _, regions, rows, cols = nodes.shape
    lines = place // cols
    columns = lines // rows
    return NodeTable(nodes, block, columns // regions, columns % regions, lines % rows, place % cols)
