"""The lists of Gaussians of all tiles for `blocks` and `grids`: stored compactly, and unfolded on loading."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from kcgs.kernels import Z_LIMIT, affine_coefficients
from kcgs.maps import TILE

from .graph import FLOAT, INT32, Graph, Value
from .groups import Group
from .packing import pack_flags, pack_integers, pack_runs, pack_sparse
from .plan import DecoderPlan
from .tables import NodeTable, Slots, make_node_table, make_slots
from .weights import ROOT


class Entries(NamedTuple):
    """The lists of a group's T tiles, padded to L Gaussians each: P = T L entries."""

    graph: Graph
    group: Group
    channels: int
    tiles: Value  # (T,)
    # (P, 6), relative to the centre of the tile: of 1, x, y, xx, xy, yy in log w; if narrow, of 1, x, y in z1 and in z2
    coefficients: Value
    colors: Value  # (P, C), zero in padding
    regions: Value  # (P,), index of the region in the map
    visible: Value | None  # (R,), factor on each region; None: all are shown

    def shaped_coefficients(self) -> Value:
        """Return the coefficients, (T, L, 6)."""
        return self._shape(self.coefficients, 6)

    def shaped_colors(self, tile_regions: Value | None = None) -> Value:
        """Return colours, (T, K * C, L), for each of the tiles' regions, (T, K): zero for those of other regions."""
        g, colors = self.graph, self._shape(self.colors, self.channels)
        if self.visible is not None:
            colors = colors * self.visible[self._shape(self.regions, 1)]
        colors = g.Transpose(colors, perm=[0, 2, 1])
        if tile_regions is None:
            return colors
        region = g.Reshape(self.regions, [len(self.group.tiles), 1, 1, self.group.longest])
        same = g.Equal(region, g.Unsqueeze(tile_regions, [2, 3])).astype(FLOAT)  # [T, K, 1, L]
        return g.Reshape(g.Unsqueeze(colors, [1]) * same, [0, self.group.regions * self.channels, -1])

    def _shape(self, values: Value, width: int) -> Value:
        return self.graph.Reshape(values, [len(self.group.tiles), self.group.longest, width])


class Storage(NamedTuple):
    """The Gaussians that a graph stores, and their lists."""

    graph: Graph
    plan: DecoderPlan
    slots: Slots
    table: NodeTable | None  # None: no coarser grids
    entries: list[Entries]  # of each group
    visible: Value | None  # (R,) float32, factor on the Gaussians of each region; None: all are shown

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.plan.gaussians.colors.shape[1])


def store_entries(g: Graph, plan: DecoderPlan, visible: Value | None) -> Storage:
    """Store the Gaussians of a plan; unfold all groups' lists at once, since every operator takes time to load."""
    slots = make_slots(g, plan)
    table = None if plan.nodes is None else make_node_table(g, plan.nodes)
    entries = _unfold_lists(g, plan, slots, table, visible) if plan.groups else []
    return Storage(g, plan, slots, table, entries, visible)


def _unfold_lists(
    g: Graph, plan: DecoderPlan, slots: Slots, table: NodeTable | None, visible: Value | None
) -> list[Entries]:
    groups, gaussians = plan.groups, plan.gaussians
    sizes = [len(group.tiles) * group.longest for group in groups]
    begins = [np.arange(size) % group.longest == 0 for size, group in zip(sizes, groups, strict=True)]
    tile = g.CumSum(pack_flags(g, np.concatenate(begins)), 0) - 1  # rank of each entry's tile
    ids, mask = _list_gaussians(g, plan, slots, tile, sum(sizes))
    squares, polynomials = (g.split(part, sizes) for part in _whiten(g, plan, slots, table, ids, tile))
    colors = g.split(g.constant(gaussians.colors)[ids] * mask, sizes)
    regions = g.split(pack_integers(g, gaussians.region)[ids], sizes)
    return [
        Entries(
            g,
            group,
            channels=gaussians.colors.shape[1],
            tiles=slots.tiles[number],
            coefficients=(squares if group.narrow else polynomials)[number],
            colors=colors[number],
            regions=regions[number],
            visible=None if group.nodes else visible,  # nodes are evaluated on loading, before `visible` is known
        )
        for number, group in enumerate(groups)
    ]


def _list_gaussians(g: Graph, plan: DecoderPlan, slots: Slots, tile: Value, count: int) -> tuple[Value, Value]:
    """Return the Gaussian of each of `count` entries, (P,), and a mask, (P, 1), that is 0 for padding."""
    lengths = pack_integers(g, np.concatenate([group.lengths for group in plan.groups]))
    longest = pack_runs(g, np.concatenate([np.full(len(group.tiles), group.longest) for group in plan.groups]))
    firsts, begins = (g.CumSum(n, 0, exclusive=1) for n in (lengths, longest))
    rank = g.Range(np.int32(0), np.int32(count), np.int32(1)) - begins[tile]
    length = lengths[tile]
    mask = g.Unsqueeze(g.Less(rank, length).astype(FLOAT), [1])
    pair = firsts[tile] + g.Min(rank, length - 1)
    return _sorted_pairs(g, plan, slots)[pair], mask


def _sorted_pairs(g: Graph, plan: DecoderPlan, slots: Slots) -> Value:
    """Return the Gaussians of all pairs of Gaussian and tile, sorted by the tile's rank, then by Gaussian.

    The file stores pairs sorted by Gaussian: the first tile of each, and the gaps between its tiles, mostly 0.
    """
    gaussian, tile = plan.pairs
    is_first = np.diff(gaussian, prepend=-1) > 0
    gaps = np.diff(tile, prepend=0) - 1
    gaps[is_first] = 0
    flags = pack_flags(g, is_first)
    owner = g.CumSum(flags, 0) - 1
    path = g.CumSum((pack_sparse(g, gaps) + 1) * (1 - flags), 0)
    begin = path[g.argsort(flags, [int(is_first.sum())], largest=1).astype(INT32)]
    base = pack_integers(g, tile[is_first]) - begin
    number = path + base[owner]
    return owner[g.argsort(slots.rank[number], [len(tile)]).astype(INT32)]


def _whiten(
    g: Graph, plan: DecoderPlan, slots: Slots, table: NodeTable | None, ids: Value, tile: Value
) -> tuple[Value, Value]:
    """Return the coefficients of all entries, (P, 6) each: of whitened coordinates, and of the polynomial log w.

    Whitened coordinates z are scaled by sqrt(1/2): log w is minus their sum of squares.
    """
    place = _places(g, plan, table)[g.Concat(*slots.tiles, axis=0)].astype(FLOAT)
    centre = (place + 0.5) * TILE
    x, y = g.split(centre[tile] - g.constant(plan.gaussians.means)[ids], 2, axis=1)
    l11, l21, l22 = g.split(g.constant(plan.gaussians.cholesky)[ids], 3, axis=1)
    z = g.Concat(*affine_coefficients(x, y, l11, l21, l22), axis=1) * ROOT
    z = g.Clip(z, float(-Z_LIMIT), float(Z_LIMIT))
    e1, k1, e2, k3, k4 = g.split(z, 5, axis=1)
    squares = g.Concat(e1, k1, k1 * 0, e2, k3, k4, axis=1)
    one, x, xx = e1 * e1 + e2 * e2, e1 * k1 + e2 * k3, k1 * k1 + k3 * k3
    terms = g.Concat(one, x, e2 * k4, xx, k3 * k4, k4 * k4, axis=1)
    return squares, terms * np.array([-1, -2, -2, -1, -2, -1], np.float32)


def _places(g: Graph, plan: DecoderPlan, table: NodeTable | None) -> Value:
    """Return the columns and rows of all tiles and blocks of nodes, (n, 2)."""
    tiles = plan.tiles
    tile = g.Range(np.int32(0), np.int32(len(tiles.regions)), np.int32(1))
    cols, rows = tile % tiles.cols, tile // tiles.cols
    if table is not None:
        cols, rows = g.Concat(cols, table.col, axis=0), g.Concat(rows, table.row, axis=0)
    return g.Concat(g.Unsqueeze(cols, [1]), g.Unsqueeze(rows, [1]), axis=1)
