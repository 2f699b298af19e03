"""Where the pixels of the output lie along one side of the scene, and which blocks they make up."""

from __future__ import annotations

import numpy as np

from kcgs.kernels.tiles import TILE

from .graph import FLOAT, INT64, Graph, Value

# places between two pixel centres that hard contours are sampled at, as in `RegionMap.resize`
_OFFSETS = 1024
# nodes, two pixels apart, that the cubic B-splines of a tile read
NODES = TILE // 2 + 3
# parts of a pixel that the ends of a view are given in
_PARTS = 1 << 20


class Axis:
    """Rows, or columns, of the output.

    Pixels whose centres lie in the same tile of the scene make a run; runs are cut into blocks of one length, at most
    `TILE` pixels, with some pixels to spare at the ends of runs. Places are integers over a common denominator: pixel i
    is at (2 n start + (2 i + 1) (end - start)) / 2 n, so that a contour's pixels fall on the same side everywhere, and
    not all runtimes have float64. `size`, int64 (1,), counts the pixels of the output, `length` those of the scene;
    `ends`, float32 (1,) each, bound the part of the scene that fills the output. Where its pixels are
    larger than those of the scene, more are rendered first, as many as the scene has there and at most twice those of
    the whole; `shrink` then takes means. So the attribute `size` is what is rendered.
    """

    def __init__(self, graph: Graph, size: Value, length: int, ends: tuple[Value, Value] | None = None) -> None:
        g = self.g = graph
        self.output, self.length, self.tiles = size, length, -(-length // TILE)
        if ends is None:
            start, extent = g.constant([0]), g.constant([length * _PARTS])
        else:
            start, end = (g("Cast", g("Mul", bound, np.float32(_PARTS)), to=INT64) for bound in ends)
            extent = g("Sub", end, start)
        # rounded up, but for what rounding of the ends may add; a view far beyond the scene has no more to show
        needed = g("Div", g("Add", extent, _PARTS - 1 - _PARTS // 256), _PARTS)
        size = self.size = g("Max", size, g("Min", needed, 2 * length))
        self.extent, self.parts = extent, g("Mul", size, 2 * _PARTS)  # of the scene; of a pixel of it
        self.step = g("Div", g("Cast", extent, to=FLOAT), g("Cast", g("Mul", size, _PARTS), to=FLOAT))
        places = g("Range", np.int64(0), g("Squeeze", size), np.int64(1))
        odd = g("Add", g("Mul", places, 2), 1)
        self.centre = g("Add", g("Mul", odd, extent), g("Mul", g("Mul", size, 2), start))  # in parts
        # bounded once it is small: onnxruntime 1.31 takes the wrong one of two int64 beyond 32 bits
        tile = g("Div", self.centre, g("Mul", self.parts, TILE))
        self._cut(g("Min", g("Max", tile, 0), self.tiles - 1), places)

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
        pixels = g("Min", inside, g("Sub", self.size, 1))  # (blocks, side)
        # in the coordinates of the block's tile, in parts
        corner = g("Mul", g("Mul", self.tile, TILE), self.parts)
        self.local = g("Sub", g("Gather", self.centre, pixels), g("Unsqueeze", corner, g.constant([1])))
        # from the middle of a block, where polynomials are rounded least
        middle = g("Mul", g("Cast", g("Sub", self.side, 1), to=FLOAT), np.float32(0.5))
        self.steps = g("Mul", g("Sub", g("Cast", within, to=FLOAT), middle), self.step)  # (side,)
        begin = g("Cast", g("Sub", g("Gather", self.centre, first), corner), to=FLOAT)
        begin = g("Div", begin, g("Cast", self.parts, to=FLOAT))
        # (blocks,), from the tile's centre
        self.origins = g("Add", g("Sub", begin, np.float32(TILE / 2)), g("Mul", middle, self.step))

    def weights(self, soft: bool) -> Value:
        """Weights of a window, a tile and the pixels around it, at the pixels of each block: (blocks, side, window).

        Where contours are hard, offsets are such that no two labels weigh the same.
        """
        g = self.g
        # a view may go beyond the scene, where the border's are held
        if soft:
            position = g("Div", g("Cast", self.local, to=FLOAT), g("Cast", self.parts, to=FLOAT))
            position = g("Add", position, np.float32(0.5))
            first = g("Unsqueeze", g("Sub", np.int64(1), g("Mul", self.tile, TILE)), g.constant([1]))
            ends = (g("Cast", g("Add", first, np.int64(n)), to=FLOAT) for n in (0, self.length - 1))
            position = g("Min", g("Max", position, next(ends)), next(ends))
            position = g("Unsqueeze", position, g.constant([2]))
        else:
            # in halves of a part; from the first pixel's centre
            position = g("Add", g("Mul", g("Unsqueeze", self.local, g.constant([2])), 2), self.parts)
            offsets = g("Max", g("Div", g("Mul", position, _OFFSETS // 2), self.parts), 0)
            offsets = g("Min", offsets, (TILE + 1) * _OFFSETS - 1)
            position = g("Div", g("Cast", g("Add", g("Mul", offsets, 2), 1), to=FLOAT), np.float32(2 * _OFFSETS))
        window = np.arange(TILE + 2, dtype=np.float32)
        return g("Relu", g("Sub", np.float32(1), g("Abs", g("Sub", position, window))))

    def spline(self) -> Value:
        """Weights of a tile's nodes, two pixels apart, at the pixels of each block, (blocks, side, NODES).

        Beyond the scene the values of its border are held.
        """
        g = self.g
        position = g("Div", g("Cast", self.local, to=FLOAT), g("Cast", self.parts, to=FLOAT))
        last = g("Cast", g("Sub", np.int64(self.length), g("Mul", self.tile, TILE)), to=FLOAT)
        last = g("Unsqueeze", g("Min", last, np.float32(TILE)), g.constant([1]))
        position = g("Min", g("Max", position, np.float32(0)), last)
        position = g("Add", g("Mul", g("Unsqueeze", position, g.constant([2])), np.float32(0.5)), np.float32(1))
        distance = g("Abs", g("Sub", position, np.arange(NODES, dtype=np.float32)))
        far, near = (g("Relu", g("Sub", np.float32(reach), distance)) for reach in (2, 1))
        far, near = (g("Mul", g("Mul", part, part), part) for part in (far, near))
        return g("Sub", g("Mul", far, np.float32(1 / 6)), g("Mul", near, np.float32(2 / 3)))

    def shrink(self, g: Graph, image: Value, axis: int) -> Value:
        """Reduce `size` pixels to those of the output: each is the mean over its share of the length."""
        begin = g("Mul", g("Range", np.int64(0), g("Squeeze", self.output), np.int64(1)), self.size)
        begin = g("Unsqueeze", begin, g.constant([1]))
        most = g("Add", g("Div", g("Add", self.size, g("Sub", self.output, 1)), self.output), 1)
        lines = g("Add", g("Div", begin, self.output), g("Range", np.int64(0), g("Squeeze", most), np.int64(1)))
        ends = g("Min", g("Add", begin, self.size), g("Mul", g("Add", lines, 1), self.output))
        shares = g("Sub", ends, g("Max", begin, g("Mul", lines, self.output)))
        shares = g("Div", g("Cast", g("Max", shares, 0), to=FLOAT), g("Cast", self.size, to=FLOAT))
        if axis == 2:
            shares = g("Unsqueeze", shares, g.constant([2]))
        taken = g("Gather", image, g("Min", lines, g("Sub", self.size, 1)), axis=axis)
        return g("ReduceSum", g("Mul", taken, shares), g.constant([axis + 1]), keepdims=0)
