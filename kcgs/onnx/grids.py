"""Wide Gaussians: evaluated at the nodes of coarse grids, and interpolated at the pixels by cubic B-splines.

The grids do not depend on the size of the output, so that their nodes are evaluated on loading. The output reads the
finest grid, whose nodes are two pixels apart. Blocks are stored by columns. docs/performance.md has the formulas.
"""

from __future__ import annotations

import numpy as np

from kcgs.maps import TILE

from .axis import NODES, Axis, Interpolator
from .entries import Storage
from .graph import FLOAT, INT32, Value
from .packing import pack_runs
from .tables import NodeTable
from .weights import monomials, weigh

_HALF = TILE // 2
# weights, in eighths, of the nodes of a coarse grid at a node of the finer grid, as in kcgs/kernels/cpu/spline.py: node
# 2 i is between nodes i and i + 1 of a window, node 2 i + 1 is at node i + 1
_REFINE = ((4, 4, 0), (1, 6, 1))


class CoarseGrids:
    """Sample the nodes at the pixels of blocks; `down` has their rows, `across` their columns."""

    def __init__(self, storage: Storage, table: NodeTable, down: Axis, across: Axis, cutoff: float) -> None:
        self.graph = storage.graph
        self.storage = storage
        self.table = table
        self.down = down
        self.across = across
        self.down_spline = down.spline()
        self.interpolator = Interpolator(down, across, self.down_spline, across.spline(), NODES)
        self.quarters = self._refine(self._evaluate(cutoff))  # [4 n + 1, C, 8, 8], of the finest grid's blocks

    def image(self) -> Value:
        """Sample tiles of one region, (C, V, pieces * side, width) with spare pixels; other tiles are zero."""
        g, tiles, channels = self.graph, self.storage.plan.tiles, self.storage.channels
        no_region = self.table.nodes.no_region
        regions = [no_region if number in tiles.several else ids[0] for number, ids in enumerate(tiles.regions)]
        region = pack_runs(g, np.array(regions))
        values = self._window(region, g.Range(np.int32(0), np.int32(len(regions)), np.int32(1)))
        values = g.Reshape(values, [tiles.rows, tiles.cols, channels, NODES, NODES])
        values = g.Gather(values[self.down.tile], self.across.tile, axis=1)
        # [tile column, node, (C, tile row, node)]: one matrix product for each tile column
        values = g.Transpose(values, perm=[1, 3, 2, 0, 4])
        values = g.Reshape(values, g.Concat(g.Shape(self.across.tile), [NODES, -1], axis=0))
        columns = g.Reshape(self.interpolator.columns, [0, -1, NODES]) @ values
        columns = g.Transpose(g.Flatten(columns, axis=2), perm=[1, 0])  # [(C, tile row, node), width]
        columns = g.Reshape(columns, g.Concat([channels, -1, NODES], self.across.padded, axis=0))
        return g.Reshape(self.down_spline, [0, -1, NODES]) @ columns

    def blocks(self, count: int, regions: Value, slots: Value, row: Value, col: Value) -> Value:
        """Sample the blocks of tiles with K regions, (T, K), to (T, blocks, K, C, P), stored by columns."""
        g, channels = self.graph, self.storage.channels
        tiles = [part.tiles for part in self.storage.entries if part.group.regions == count]
        tile = g.Expand(g.Unsqueeze(g.Concat(*tiles, axis=0), [1]), g.Shape(regions))
        region = g.Min(g.Reshape(regions, [-1]), np.int32(self.table.nodes.no_region))
        windows = self._window(region, g.Reshape(tile, [-1]))
        windows = g.Reshape(windows, g.Concat(g.Shape(regions, end=1), [-1, NODES, NODES], axis=0))
        return self.interpolator.blocks(windows[slots], row, col, (count, channels))

    def _window(self, region: Value, tile: Value) -> Value:
        """Return the nodes that tiles (n,) read, (n, C, column, row); nodes of hidden regions are zero."""
        g, cols = self.graph, self.storage.plan.tiles.cols
        quarters = self._find_quarters(np.int32(0), region, tile // cols, tile % cols)
        nodes = self._join(self.quarters, quarters, 0)
        nodes = g.Slice(nodes, [0, 0], [NODES, NODES], [2, 3])
        if self.storage.visible is None:
            return nodes
        factors = g.Concat(self.storage.visible, np.zeros(1, np.float32), axis=0)
        return nodes * g.Unsqueeze(factors[region], [1, 2, 3])

    def _evaluate(self, cutoff: float) -> Value:
        """Evaluate the Gaussians of every block at its nodes, (n, C, 256)."""
        g, plan, channels = self.graph, self.storage.plan, self.storage.channels
        steps = g.constant(np.arange(TILE, dtype=np.float32) - np.float32((TILE - 1) / 2))
        basis = monomials(g, g.Unsqueeze(steps, [1]), steps)
        entries = [part for part in self.storage.entries if part.group.nodes]
        values = []
        for part in entries:
            weights = weigh(g, part.shaped_coefficients() @ basis, cutoff)
            values.append(part.shaped_colors() @ weights)
        # the last block, of zeros, is for blocks without Gaussians of their own: they are only refined
        values.append(g.Expand(np.float32(0), [1, channels, TILE * TILE]))
        first = len(plan.tiles.regions)
        rank = g.Slice(self.storage.slots.rank, [first], [plan.num_blocks])
        tiles = sum(len(group.tiles) for group in plan.pixel_groups)
        last = sum(len(part.group.tiles) for part in entries)
        return g.Concat(*values, axis=0)[g.Min(rank - tiles, np.int32(last))]

    def _refine(self, values: Value) -> Value:
        """Add to each grid the interpolated next coarser grid; return the quarters of the finest grid's blocks."""
        g, channels, table = self.graph, self.storage.channels, self.table
        counts = np.bincount(table.nodes.place[:, 0]).tolist()
        ids = self._find_quarters(table.level + 1, table.region, table.row, table.col)
        grids, coarser = g.split(values, counts), g.split(ids, counts)
        matrix = np.zeros((TILE, TILE), np.uint8)
        for node in range(TILE):
            matrix[node, node // 2 : node // 2 + 3] = _REFINE[node % 2]
        along = g.constant(matrix).astype(FLOAT) * (1 / 8)
        back = g.Transpose(along, perm=[1, 0])
        quarters, first = None, sum(counts)
        for count, grid, ids in reversed(list(zip(counts, grids, coarser, strict=True))):
            grid = g.Reshape(grid, [0, channels, TILE, TILE])
            if quarters is not None:
                grid = grid + along @ self._join(quarters, ids, first) @ back
            first -= count
            grid = g.Reshape(grid, [0, channels, 2, _HALF, 2, _HALF])
            grid = g.Transpose(grid, perm=[0, 4, 2, 1, 3, 5])
            grid = g.Reshape(grid, [-1, channels, _HALF, _HALF])
            quarters = g.Concat(grid, np.zeros((1, channels, _HALF, _HALF), np.float32), axis=0)
        assert quarters is not None
        return quarters

    def _find_quarters(self, level: Value | np.int32, region: Value, row: Value, col: Value) -> Value:
        """Find the quarters of a level's blocks under blocks (n,) of the next finer level, down and across, (n, 2, 2).

        A block covers two by two quarters of the level; the first quarter has the row and column of the block.
        """
        g, (_, regions, rows, cols) = self.graph, self.table.nodes.shape
        two = g.constant(np.arange(2, dtype=np.int32))
        row, col = (g.Unsqueeze(place, [1]) + two for place in (row, col))
        (row, down), (col, right) = ((place // 2, place % 2) for place in (row, col))
        line = g.Mul(level, np.int32(regions)) + region
        line = g.Unsqueeze(line, [1]) * rows + row
        key, quarter = (
            g.Unsqueeze(y, [2]) * n + g.Unsqueeze(x, [1]) for y, n, x in ((line, cols, col), (down, 2, right))
        )
        return self.table.block[key] * 4 + quarter

    def _join(self, quarters: Value, ids: Value, first: int) -> Value:
        """Join quarters `ids`, (n, 2, 2), of blocks from `first` on, to (n, C, 16, 16); the last quarter is zero."""
        g = self.graph
        last = g.Shape(quarters, end=1).astype(INT32) - 1
        place = g.Min(ids - 4 * first, last)
        joined = g.Transpose(quarters[place], perm=[0, 3, 2, 4, 1, 5])
        return g.Reshape(joined, [0, self.storage.channels, TILE, TILE])
