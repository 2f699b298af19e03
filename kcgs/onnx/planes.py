"""What wide Gaussians render, carried from coarse grids to the pixels by cubic B-splines.

Grids are of the scene, not of the output: blocks of nodes are evaluated and refined when the decoder is loaded, and the
output reads the nodes two pixels apart. Blocks lie in memory column by column.
"""

from __future__ import annotations

import numpy as np

from kcgs.kernels.tiles import TILE

from .axis import NODES, Axis
from .graph import FLOAT, INT32, Graph, Value
from .layout import Nodes
from .stored import Stored, monomials, weigh

F32 = np.float32
_HALF = TILE // 2
# a node and the nodes of the next grid around it: node 2 i lies between i and i + 1 of a window, 2 i + 1 at i + 1
_REFINE = ((4, 4, 0), (1, 6, 1))


class Planes:
    """Samples the nodes at the pixels of blocks, whose rows and columns are `down` and `across`."""

    def __init__(self, graph: Graph, stored: Stored, nodes: Nodes, down: Axis, across: Axis, cutoff: float) -> None:
        self.stored, self.channels = stored, stored.channels
        self.g, self.nodes, self.cutoff, self.tiles = graph, nodes, cutoff, stored.layout.tiles
        self._down_axis, self._across_axis = down, across
        self._across = across.spline()  # [blocks, side, NODES]
        self._down = down.spline()
        self._quarters = self._refine(self._evaluate())

    def grid(self) -> Value:
        """Sample tiles of one region, (blocks, C, side, width); the others are zero."""
        g, tiles, (_, regions, _, _) = self.g, self.tiles, self.nodes.shape
        down, across = self._down_axis, self._across_axis
        of_tile = [regions - 1 if number in tiles.windows else found[0] for number, found in enumerate(tiles.regions)]
        region, tile = g.piecewise(np.array(of_tile)), g("Range", np.int32(0), np.int32(len(of_tile)), np.int32(1))
        shape = g.constant([tiles.rows, tiles.cols, -1, NODES, NODES])
        values = g("Reshape", self._window(region, tile), shape)
        # [tile column, node, (tile row, C, node)]: what is beyond the tile column is multiplied at once
        values = g("Transpose", values, perm=[1, 3, 0, 2, 4])
        values = g("Reshape", values, g.constant([tiles.cols, NODES, -1]))
        columns = g("MatMul", self._across, g("Gather", values, across.tile))  # [blocks, side, (tile row, C, node)]
        columns = g("Reshape", columns, g.constant([-1, tiles.rows * self.channels * NODES]))
        columns = g("Transpose", g("Gather", columns, across.place), perm=[1, 0])
        shape = g("Concat", g.constant([tiles.rows, self.channels, NODES]), across.size, axis=0)
        columns = g("Gather", g("Reshape", columns, shape), down.tile)  # [blocks, C, node, width]
        return g("MatMul", g("Unsqueeze", self._down, g.constant([1])), columns)

    def blocks(self, number: int, regions: Value, slots: Value, row: Value, col: Value) -> Value:
        """Sample blocks (B,) of tiles with several regions, (B, K * C, P), as `Windows.weights` does."""
        g, one, group = self.g, self.g.constant([1]), self.stored.layout.groups[number]
        tile = g("Unsqueeze", self.stored.tiles[number], one)
        tile = g("Reshape", g("Expand", tile, g("Shape", regions)), g.constant([-1]))
        region = g("Min", g("Reshape", regions, g.constant([-1])), np.int32(self.nodes.shape[1] - 1))
        values = self._window(region, tile)
        count = group.regions * self.channels
        values = g("Reshape", values, g.constant([len(group.tiles), count * NODES, NODES]))
        rows = g("MatMul", g("Gather", values, slots), g("Gather", g("Transpose", self._down, perm=[0, 2, 1]), row))
        rows = g("Reshape", rows, g("Concat", g.constant([0, count, NODES]), self._down_axis.side, axis=0))
        image = g("MatMul", g("Unsqueeze", g("Gather", self._across, col), one), rows)
        return g("Reshape", image, g.constant([0, count, -1]))

    def _read(self, level: Value | np.int32, region: Value, row: Value, col: Value) -> Value:
        """Which quarters of blocks of a level blocks (n,) of the finer one lie in, down and across, (n, 2, 2).

        A block is as large as two by two quarters, from the one of its own row and column on.
        """
        g, (_, regions, rows, cols) = self.g, self.nodes.shape
        two = g.constant(np.arange(2, dtype=np.int32))
        row, col = (g("Add", g("Unsqueeze", n, g.constant([1])), two) for n in (row, col))
        (row, down), (col, right) = ([g(op, n, np.int32(2)) for op in ("Div", "Mod")] for n in (row, col))
        line = g("Add", g("Mul", level, np.int32(regions)), region)
        line = g("Add", g("Mul", g("Unsqueeze", line, g.constant([1])), np.int32(rows)), row)
        key, quarter = (
            g("Add", g("Mul", g("Unsqueeze", y, g.constant([2])), np.int32(n)), g("Unsqueeze", x, g.constant([1])))
            for y, n, x in ((line, cols, col), (down, 2, right))
        )
        return g("Add", g("Mul", g("Gather", self.stored.block_of, key), np.int32(4)), quarter)

    def _join(self, quarters: Value, read: Value, first: int) -> Value:
        """Join quarters, (n, 2, 2), of blocks from `first` on, to (n, C, 16, 16); the last quarter is zero."""
        g = self.g
        last = g("Sub", g("Cast", g("Shape", quarters, end=1), to=INT32), np.int32(1))
        place = g("Min", g("Sub", read, np.int32(4 * first)), last)
        joined = g("Transpose", g("Gather", quarters, place), perm=[0, 3, 2, 4, 1, 5])
        return g("Reshape", joined, g.constant([0, self.channels, TILE, TILE]))

    def _window(self, region: Value, tile: Value) -> Value:
        """Return the nodes that tiles (n,) read, (n, C, column, row), and hide what is not to be shown."""
        g, cols = self.g, np.int32(self.tiles.cols)
        read = self._read(np.int32(0), region, g("Div", tile, cols), g("Mod", tile, cols))
        nodes = self._join(self._quarters, read, 0)
        nodes = g("Slice", nodes, g.constant([0, 0]), g.constant([NODES, NODES]), g.constant([2, 3]))
        if self.stored.visible is None:
            return nodes
        factors = g("Concat", self.stored.visible, np.zeros(1, F32), axis=0)
        return g("Mul", nodes, g("Unsqueeze", g("Gather", factors, region), g.constant([1, 2, 3])))

    def _evaluate(self) -> Value:
        """Evaluate the Gaussians of every block at its nodes, (n, C, 256)."""
        g, stored, layout = self.g, self.stored, self.stored.layout
        steps = g.constant(np.arange(TILE, dtype=F32) - F32((TILE - 1) / 2))
        at_nodes = monomials(g, steps, steps)
        values, spare, last = [], 0, 0
        for number, group in enumerate(layout.groups):
            if not group.nodes:
                spare += len(group.tiles)
                continue
            last += len(group.tiles)
            weights = weigh(g, g("MatMul", stored.coefficients(number), at_nodes), self.cutoff)
            values.append(g("MatMul", stored.colors(number, None), weights))
        # the last is for blocks that are only refined
        values.append(g("Expand", F32(0), g.constant([1, self.channels, TILE * TILE])))
        first = len(layout.tiles.regions)
        place = g("Slice", stored.place, g.constant([first]), g.constant([first + len(self.nodes.place)]))
        return g("Gather", g("Concat", *values, axis=0), g("Min", g("Sub", place, np.int32(spare)), np.int32(last)))

    def _refine(self, values: Value) -> Value:
        """Add to each grid what the next coarser one says there; return the quarters of the finest one's blocks."""
        g, counts = self.g, np.bincount(self.nodes.place[:, 0]).tolist()
        level, *rest = self.stored.nodes
        grids, read = (g.split(part, counts) for part in (values, self._read(g("Add", level, np.int32(1)), *rest)))
        matrix = np.zeros((TILE, TILE), np.uint8)
        for node in range(TILE):
            matrix[node, node // 2 : node // 2 + 3] = _REFINE[node % 2]
        along = g("Mul", g("Cast", g.constant(matrix), to=FLOAT), F32(1 / 8))
        back, shape = g("Transpose", along, perm=[1, 0]), g.constant([0, self.channels, TILE, TILE])
        quarters, first = None, sum(counts)
        for number in range(len(counts) - 1, -1, -1):
            grid = g("Reshape", grids[number], shape)
            if quarters is not None:
                window = self._join(quarters, read[number], first)
                grid = g("Add", grid, g("MatMul", g("MatMul", along, window), back))
            first -= counts[number]
            grid = g("Reshape", grid, g.constant([0, self.channels, 2, _HALF, 2, _HALF]))
            grid = g("Transpose", grid, perm=[0, 4, 2, 1, 3, 5])
            grid = g("Reshape", grid, g.constant([-1, self.channels, _HALF, _HALF]))
            quarters = g("Concat", grid, np.zeros((1, self.channels, _HALF, _HALF), F32), axis=0)
        assert quarters is not None
        return quarters
