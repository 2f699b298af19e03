"""What a graph stores of the Gaussians, and how that is unfolded: once, when the decoder is loaded."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kcgs.kernels.tiles import TILE
from kcgs.kernels.whitened import Z_LIMIT

from .graph import FLOAT, INT32, INT64, Graph, Value
from .layout import Layout, Nodes

F32 = np.float32
_ROOT = math.sqrt(0.5)


def monomials(g: Graph, x: Value, y: Value) -> Value:
    """Make 1, x, y, xx, xy, yy at the pixels of a block, column by column, (6, P); of its columns and rows."""
    x, y = g("Unsqueeze", x, g.constant([1])), g("Unsqueeze", y, g.constant([0]))
    sides = g("Concat", g("Shape", x, end=1), g("Shape", y, start=1), axis=0)
    x, y = (g("Reshape", g("Expand", part, sides), g.constant([-1])) for part in (x, y))
    one = g("Add", g("Mul", x, F32(0)), F32(1))
    rows = (one, x, y, g("Mul", x, x), g("Mul", x, y), g("Mul", y, y))
    return g("Concat", *[g("Unsqueeze", r, g.constant([0])) for r in rows], axis=0)


def weigh(g: Graph, exponent: Value, cutoff: float) -> Value:
    """Make weights of their logarithms, 0 where they are below the cutoff."""
    weight = g("Exp", exponent)
    if cutoff == 0:
        return weight
    # keeps what is greater; the least weight that counts is the cutoff itself
    return g("ThresholdedRelu", weight, alpha=float(np.nextafter(F32(cutoff), F32(0))))


class Stored:
    """The entries of all groups, one after the other: coefficients of log w around the centre of the tile, and colours.

    Whitened coordinates z are scaled by sqrt(1/2): log w is minus their sum of squares. All that does not depend on the
    size of the image is computed for all groups at once, since the time to load grows with the number of operators.
    `visible` is a factor on each region's Gaussians, (R,).
    """

    def __init__(self, graph: Graph, layout: Layout, visible: Value | None) -> None:
        g = self.g = graph
        self.layout, self.gaussians, groups = layout, layout.gaussians, layout.groups
        self.visible = visible
        self.channels = self.gaussians.colors.shape[1]
        # of each tile or block: its group, one beyond them where nothing touches it, and its slot there
        count = len(layout.tiles.regions) + (0 if layout.nodes is None else len(layout.nodes.place))
        group_of = np.full(count, len(groups))
        for number, group in enumerate(groups):
            group_of[group.tiles] = number
        self.group_of = g.whole(group_of)
        order = self._argsort(self.group_of, count)
        self.place = self._argsort(order, count)  # among those of all groups
        starts = np.cumsum([0, *(len(group.tiles) for group in groups)])
        self.slot_of = g("Sub", self.place, g("Gather", g.constant(starts.astype(np.int32)), self.group_of))
        if not groups:
            return
        self.tiles = g.split(g("Slice", order, g.constant([0]), g.constant(starts[-1:])), np.diff(starts).tolist())
        self._sizes = [len(group.tiles) * group.longest for group in groups]
        tile = self._tile_of_entries()
        entries, real = self._entries(tile)
        squares, polynomials = self._whiten(entries, tile)
        self._squares, self._polynomials = (g.split(part, self._sizes) for part in (squares, polynomials))
        self._colors = g.split(g("Mul", g("Gather", g.constant(self.gaussians.colors), entries), real), self._sizes)
        if visible is not None or any(group.regions > 1 for group in groups):
            self._regions = g.split(g("Gather", g.whole(self.gaussians.region), entries), self._sizes)

    def coefficients(self, number: int) -> Value:
        """Coefficients of a group, (T, L, 6): of 1, x, y, xx, xy, yy in log w; or, narrow, of 1, x, y in z1 and z2."""
        narrow = self.layout.groups[number].narrow
        return self._shaped(self._squares if narrow else self._polynomials, number, 6)

    def colors(self, number: int, regions: Value | None) -> Value:
        """Colours of a group, (T, K * C, L), zero where a Gaussian is of another of the tiles' regions, (T, K)."""
        g, group = self.g, self.layout.groups[number]
        colors = self._shaped(self._colors, number, self.channels)
        if self.visible is not None and not group.nodes:  # planes are made when the decoder is loaded
            colors = g("Mul", colors, g("Gather", self.visible, self._shaped(self._regions, number, 1)))
        colors = g("Transpose", colors, perm=[0, 2, 1])  # [T, C, L]
        if regions is None:
            return colors
        region = self._shaped(self._regions, number, place=(1, 1))
        same = g("Cast", g("Equal", region, g("Unsqueeze", regions, g.constant([2, 3]))), to=FLOAT)  # [T, K, 1, L]
        colors = g("Mul", g("Unsqueeze", colors, g.constant([1])), same)
        return g("Reshape", colors, g.constant([0, group.regions * self.channels, -1]))

    def _shaped(self, values: Sequence[Value], number: int, *width: int, place: tuple[int, ...] = ()) -> Value:
        group = self.layout.groups[number]
        return self.g("Reshape", values[number], self.g.constant([len(group.tiles), *place, group.longest, *width]))

    def _tile_of_entries(self) -> Value:
        """Place of each entry's tile among the tiles of all groups, (P,)."""
        sizes = zip(self._sizes, self.layout.groups, strict=True)
        begins = [np.arange(size) % group.longest == 0 for size, group in sizes]
        return self.g("Sub", self.g("CumSum", self.g.flags(np.concatenate(begins)), np.int64(0)), np.int32(1))

    def _entries(self, tile: Value) -> tuple[Value, Value]:
        """Which Gaussian each entry is, (P,), and 1 for entries, 0 for what lists are filled up with, (P, 1)."""
        g, groups = self.g, self.layout.groups
        counts = g.whole(np.concatenate([group.lengths for group in groups]))
        sides = g.piecewise(np.concatenate([np.full(len(group.tiles), group.longest) for group in groups]))
        firsts, begins = (g("CumSum", n, np.int64(0), exclusive=1) for n in (counts, sides))
        rank = g("Sub", g("Range", np.int32(0), np.int32(sum(self._sizes)), np.int32(1)), g("Gather", begins, tile))
        count = g("Gather", counts, tile)
        real = g("Unsqueeze", g("Cast", g("Less", rank, count), to=FLOAT), g.constant([1]))
        place = g("Add", g("Gather", firsts, tile), g("Min", rank, g("Sub", count, np.int32(1))))
        return g("Gather", self._sorted_pairs(), place), real

    def _sorted_pairs(self) -> Value:
        """Which Gaussian each pair of Gaussian and tile is of, sorted by the tile's place, then by Gaussian.

        They are stored the other way, Gaussian by Gaussian: its first tile, and how many tiles lie between one and the
        next, which is mostly none.
        """
        g, (gaussian, tile) = self.g, self.layout.pairs
        fresh = np.diff(gaussian, prepend=-1) > 0
        gaps = np.diff(tile, prepend=0) - 1
        gaps[fresh] = 0
        is_first = g.flags(fresh)
        owner = g("Sub", g("CumSum", is_first, np.int64(0)), np.int32(1))
        steps = g("Mul", g("Add", g.sparse(gaps), np.int32(1)), g("Sub", np.int32(1), is_first))
        path = g("CumSum", steps, np.int64(0))
        begin = g("Gather", path, self._argsort(is_first, int(fresh.sum()), largest=1))
        base = g("Sub", g.whole(tile[fresh]), begin)
        number = g("Add", path, g("Gather", base, owner))
        return g("Gather", owner, self._argsort(g("Gather", self.place, number), len(tile)))

    def _argsort(self, numbers: Value, count: int, largest: int = 0) -> Value:
        """Where the `count` smallest or largest numbers are, sorted; of equal ones, the first comes first.

        So it finds flags, too: onnxruntime would leave Compress for every run.
        """
        keys = self.g("Cast", numbers, to=INT64)
        order = self.g.apply("TopK", [keys, self.g.constant([count])], 2, largest=largest, axis=0)[1]
        return self.g("Cast", order, to=INT32)

    def _places(self) -> Value:
        """Columns and rows of tiles, and of blocks of nodes, (n, 2)."""
        g, tiles, nodes = self.g, self.layout.tiles, self.layout.nodes
        tile = g("Range", np.int32(0), np.int32(len(tiles.regions)), np.int32(1))
        places = [g(op, tile, np.int32(tiles.cols)) for op in ("Mod", "Div")]
        if nodes is not None:
            self._find_nodes(nodes)
            places = [g("Concat", *pair, axis=0) for pair in zip(places, self.nodes[:1:-1], strict=True)]
        return g("Concat", *[g("Unsqueeze", part, g.constant([1])) for part in places], axis=1)

    def _find_nodes(self, nodes: Nodes) -> None:
        """Make the table of the blocks of nodes by level, region, row and column, and their places in it."""
        g, count = self.g, len(nodes.place)
        flags = np.zeros(nodes.shape, np.bool_)
        flags[tuple(nodes.place.T)] = True
        present = g.flags(flags.ravel())
        number = g("Sub", g("CumSum", present, np.int64(0)), np.int32(1))
        # n, a block of zeros, where there is none
        self.block_of = g("Where", g("Equal", present, np.int32(1)), number, np.int32(count))
        place = self._argsort(present, count, largest=1)
        self.nodes: list[Value] = []  # level - 1, region, row, column
        for length in nodes.shape[:0:-1]:
            self.nodes.insert(0, g("Mod", place, np.int32(length)))
            place = g("Div", place, np.int32(length))
        self.nodes.insert(0, place)

    def _whiten(self, entries: Value, tile: Value) -> tuple[Value, Value]:
        g = self.g
        place = g("Cast", g("Gather", self._places(), g("Concat", *self.tiles, axis=0)), to=FLOAT)
        centre = g("Mul", g("Add", place, F32(0.5)), F32(TILE))
        offset = g("Sub", g("Gather", centre, tile), g("Gather", g.constant(self.gaussians.means), entries))
        x, y = g.apply("Split", [offset], 2, axis=1, num_outputs=2)
        cholesky = g("Gather", g.constant(self.gaussians.cholesky), entries)
        l11, l21, l22 = g.apply("Split", [cholesky], 3, axis=1, num_outputs=3)
        slope = g("Div", l21, l11)
        e1, k1, k4 = g("Div", x, l11), g("Reciprocal", l11), g("Reciprocal", l22)
        e2 = g("Div", g("Sub", y, g("Mul", slope, x)), l22)
        k3 = g("Neg", g("Div", slope, l22))
        z = g("Mul", g("Concat", e1, k1, e2, k3, k4, axis=1), F32(_ROOT))
        z = g("Clip", z, F32(-Z_LIMIT), F32(Z_LIMIT))
        e1, k1, e2, k3, k4 = g.apply("Split", [z], 5, axis=1, num_outputs=5)
        squares = g("Concat", e1, k1, g("Mul", k1, F32(0)), e2, k3, k4, axis=1)
        sums = [g("Add", g("Mul", e1, a), g("Mul", e2, b)) for a, b in ((e1, e2), (k1, k3))]
        xx = g("Add", g("Mul", k1, k1), g("Mul", k3, k3))
        terms = g("Concat", *sums, g("Mul", e2, k4), xx, g("Mul", k3, k4), g("Mul", k4, k4), axis=1)
        return squares, g("Mul", terms, np.array([-1, -2, -2, -1, -2, -1], F32))
