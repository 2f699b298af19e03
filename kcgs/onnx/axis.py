"""Where the pixels of the output lie along one side of the scene, and which blocks they make up."""

from __future__ import annotations

import numpy as np

from .graph import Graph, Value
from .lists import TILE

INT32, INT64, FLOAT, DOUBLE = 6, 7, 1, 11  # ONNX's numbers of its types
_OFFSETS = 1024


class Axis:
    """Rows, or columns, of the output.

    Pixels whose centres lie in the same tile of the scene make a run; runs are cut into blocks of one length, at most
    `TILE` pixels, with some pixels to spare at the ends of runs. Places are computed in float64 by the same operations
    as in `RegionMap.resize`, since a contour's pixel falls on one side or the other.
    """

    def __init__(
        self, graph: Graph, size: Value, length: int, start: Value | None = None, end: Value | None = None
    ) -> None:
        """Take the sizes.

        Args:
            graph: the graph.
            size: int64 (1,), pixels of the output.
            length: pixels of the scene.
            start: float64 (1,), where the output begins in the scene; None: 0.
            end: float64 (1,), where it ends; None: length.
        """
        g = self.g = graph
        self.size, self.tiles = size, -(-length // TILE)
        extent = g.constant(np.array([length], np.float64))
        if start is not None and end is not None:
            extent = g("Sub", end, start)
        self.step = g("Div", extent, g("Cast", size, to=DOUBLE))  # scene pixels between pixels
        places = g("Range", np.int64(0), g("Squeeze", size), np.int64(1))
        centre = g("Mul", g("Add", g("Cast", places, to=DOUBLE), np.float64(0.5)), self.step)
        self.centre = centre if start is None else g("Add", start, centre)
        tile = g("Floor", g("Div", self.centre, np.float64(TILE)))
        tile = g("Cast", g("Clip", tile, np.float64(0), np.float64(self.tiles - 1)), to=INT64)
        self._cut(tile, places)

    def _cut(self, tile: Value, places: Value) -> None:
        g = self.g
        numbers = g.constant(np.arange(self.tiles)[:, None])
        counts = g("ReduceSum", g("Cast", g("Equal", numbers, tile), to=INT64), g.constant([1]), keepdims=0)
        starts = g("CumSum", counts, np.int64(0), exclusive=1)
        longest = g("ReduceMax", counts, keepdims=1)
        pieces = g("Div", g("Add", longest, TILE - 1), TILE)
        self.side = g("Div", g("Add", longest, g("Sub", pieces, 1)), pieces)  # (1,), pixels of a block
        rank = g("Mod", g("Sub", places, g("Gather", starts, tile)), self.side)
        begins = g("Equal", rank, 0)
        first = g("Compress", places, begins, axis=0)
        self.blocks = g("Shape", first)  # (1,)
        self.tile = g("Gather", tile, first)  # (blocks,)
        number = g("Sub", g("CumSum", g("Cast", begins, to=INT64), np.int64(0)), 1)
        self.place = g("Add", g("Mul", number, self.side), rank)  # (size,), of each pixel among those of the blocks
        # pixels of each block; those to spare at the end of the last one repeat the last pixel
        within = g("Range", np.int64(0), g("Squeeze", self.side), np.int64(1))
        inside = g("Add", g("Unsqueeze", first, g.constant([1])), within)
        self.pixels = g("Min", inside, g("Sub", self.size, 1))  # (blocks, side)
        # from the middle of a block, where polynomials are rounded least
        middle = g("Mul", g("Cast", g("Sub", self.side, 1), to=DOUBLE), np.float64(0.5))
        centred = g("Sub", g("Cast", within, to=DOUBLE), middle)
        self.steps = g("Cast", g("Mul", centred, self.step), to=FLOAT)  # (side,)
        origin = g("Add", g("Gather", self.centre, first), g("Mul", middle, self.step))
        tile_centre = g("Mul", g("Add", g("Cast", self.tile, to=DOUBLE), np.float64(0.5)), np.float64(TILE))
        self.origins = g("Cast", g("Sub", origin, tile_centre), to=FLOAT)  # (blocks,), in the tile's coordinates

    def weights(self, factor: int, halo: int, soft: bool) -> Value:
        """Weights of a window's labels or pixels at the pixels of each block, (blocks, side * factor, window).

        Args:
            factor: labels along a side of a pixel.
            halo: labels around a tile.
            soft: whether to interpolate; else offsets are such that no two labels weigh the same.
        """
        g = self.g
        centre = g("Gather", self.centre, self.pixels)
        spread = (np.arange(factor) + 0.5) / factor - 0.5
        narrowed = g("Mul", g.constant(spread), g("Min", self.step, np.array([1.0])))
        at = g("Add", g("Unsqueeze", centre, g.constant([2])), narrowed)  # (blocks, side, factor)
        at = g("Sub", g("Mul", at, np.float64(factor)), np.float64(0.5))
        if not soft:
            low = g("Floor", at)
            odd = g("Add", g("Floor", g("Mul", g("Sub", at, low), np.float64(_OFFSETS))), np.float64(0.5))
            at = g("Add", low, g("Div", odd, np.float64(_OFFSETS)))
        base = g("Sub", g("Mul", self.tile, factor * TILE), halo)
        base = g("Reshape", g("Cast", base, to=DOUBLE), g.constant([-1, 1, 1]))
        at = g("Reshape", g("Cast", g("Sub", at, base), to=FLOAT), g.constant(np.array([0, -1, 1])))
        window = np.arange(factor * TILE + 2 * halo, dtype=np.float32)
        return g("Relu", g("Sub", np.float32(1), g("Abs", g("Sub", at, window))))
