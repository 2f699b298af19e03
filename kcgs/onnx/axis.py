"""The pixels of the output along one side of the scene, and their blocks: for `blocks`, `grids` and `membership`."""

from __future__ import annotations

import math

import numpy as np

from kcgs.maps import TILE

from .graph import FLOAT, INT64, Graph, Value

# nodes, two pixels apart, that the cubic B-splines of a tile read
NODES = TILE // 2 + 3
# parts per pixel of the scene: the ends of a view are rounded to them
_PARTS = 1 << 20


class Axis:
    """Rows, or columns, of the output.

    Pixels whose centres lie in the same tile of the scene form a run. Every run is cut into the same number of blocks,
    all of the same length, at most `TILE` pixels; shorter runs have spare pixels at their end. Places are integers over
    a common denominator: pixel i is at (2 n start + (2 i + 1) (end - start)) / 2 n. So a contour's pixels are on the
    same side in every runtime, without float64, which some runtimes lack. If output pixels are larger than pixels of
    the scene, more pixels are rendered first: as many as the scene has in this part, but at most twice the pixels of
    the whole scene; `shrink` then averages them.

    Attributes:
        size: rendered pixels, (1,).
        parts: unit of `local`: parts per pixel of the scene, (1,).
        step: pixels of the scene per rendered pixel, (1,) float32.
        tile: consecutive tiles, one for each of the V runs, (V,); a constant if the whole scene is rendered.
        runs: pixels of each run, (V,).
        pieces: blocks of a run, (1,).
        side: pixels of a block, (1,).
        is_aligned: rendered pixels have the size and the places of the scene's pixels, (1,) bool.
        is_native: `is_aligned`, and each tile is one block from 0 on, (1,) bool.
        local: pixel centres relative to the corner of their tile, (V, pieces, side).
        steps: pixel centres relative to the middle of a block, where polynomials have least rounding, (side,).
        origins: middles of blocks relative to the centre of their tile, (V, pieces).
    """

    def __init__(self, g: Graph, output: Value, length: int, ends: tuple[Value, Value] | None = None) -> None:
        """Place `output` pixels, (1,), along a scene of `length` pixels, or the part between `ends`, (1,) each."""
        self.graph = g
        self.output = output
        self.length = length
        start, extent = _bounds(g, length, ends)
        self._set_scale(extent)
        shift = self.size * 2 * start
        self.tile = self._tiles(shift, extent, is_whole=ends is None)
        corner = self.tile * TILE * self.parts
        begin = self._set_runs(corner - shift, extent)
        self.is_aligned = g.And(g.Equal(start % _PARTS, 0), g.Equal(extent, self.size * _PARTS))
        self.is_native = g.And(g.And(g.Equal(start, 0), self.is_aligned), g.Equal(self.side, TILE))
        self._set_places(begin, corner, shift, extent)

    def _set_scale(self, extent: Value) -> None:
        g = self.graph
        # rounded up, with a tolerance for the rounding of the ends; a view far beyond the scene needs no more pixels
        pixels = (extent + (_PARTS - 1 - _PARTS // 256)) // _PARTS
        self.size = g.Max(self.output, g.Min(pixels, 2 * self.length))
        self.parts = self.size * (2 * _PARTS)
        self.step = extent.astype(FLOAT) / (self.size * _PARTS).astype(FLOAT)

    def _set_runs(self, corner: Value, extent: Value) -> Value:
        """Cut the pixels into runs, and these into blocks; return the first pixel of each run, (V,)."""
        g = self.graph
        # a run begins at the first pixel whose centre is not left of the corner; pixels left of the scene are tile 0's
        begin = g.Max((corner + extent - 1) // (extent * 2), 0) * g.Min(self.tile, 1)
        end = g.Concat(g.Slice(begin, [1], [1 << 30], [0]), self.size, axis=0)
        self.runs = end - begin
        longest = g.ReduceMax(self.runs, keepdims=1)
        self.pieces = (longest + (TILE - 1)) // TILE
        self.side = (longest + (self.pieces - 1)) // self.pieces
        return begin

    def _set_places(self, begin: Value, corner: Value, shift: Value, extent: Value) -> None:
        g = self.graph
        within = g.Range(0, g.Squeeze(self.pieces * self.side), 1)
        within = g.Reshape(within, g.Concat([1], self.pieces, self.side, axis=0))
        axes = g.constant([1, 2])
        pixel = g.Unsqueeze(begin, axes) + within
        self.local = (pixel * 2 + 1) * extent + (shift - g.Unsqueeze(corner, axes))
        middle = (self.side - 1).astype(FLOAT) * 0.5
        self.steps = (g.Range(0, g.Squeeze(self.side), 1).astype(FLOAT) - middle) * self.step
        firsts = g.Gather(self.local, 0, axis=2).astype(FLOAT) / self.parts.astype(FLOAT)
        self.origins = firsts + (middle * self.step - TILE / 2)

    def _tiles(self, shift: Value, extent: Value, is_whole: bool) -> Value:
        """Return the tiles from that of the first pixel to that of the last."""
        g, count = self.graph, -(-self.length // TILE)
        if is_whole:
            return g.constant(np.arange(count))
        centres = (extent + shift, (self.size * 2 - 1) * extent + shift)
        # clip after the division: Min and Max of onnxruntime 1.31 are wrong for int64 beyond 32 bits
        first, last = (g.Squeeze(g.Min(g.Max(c // (self.parts * TILE), 0), count - 1)) for c in centres)
        return g.Range(first, last + 1, 1)

    @property
    def padded(self) -> Value:
        """Number of pixels of all blocks, (1,)."""
        return self.graph.Shape(self.runs) * self.pieces * self.side

    def sampling(self) -> Value:
        """Return bilinear weights of a window (a tile and the pixels around it), (V, pieces, side, window)."""
        g = self.graph
        position = g.Unsqueeze(self.local, [3]).astype(FLOAT) / self.parts.astype(FLOAT) + 0.5
        # outside the scene, a view has the values of the scene's border
        first = g.Unsqueeze(1 - self.tile * TILE, [1, 2, 3])
        for clip, end in ((g.Max, 0), (g.Min, self.length - 1)):
            position = clip(position, (first + end).astype(FLOAT))
        return g.Relu(1 - g.Abs(position - np.arange(TILE + 2, dtype=np.float32)))

    def spline(self) -> Value:
        """Return cubic B-splines, the weights of a tile's nodes at each block's pixels, (V, pieces, side, NODES).

        Outside the scene the values of its border hold.
        """
        g = self.graph
        position = g.Unsqueeze(self.local, [3]).astype(FLOAT) / self.parts.astype(FLOAT)
        last = (self.length - self.tile * TILE).astype(FLOAT)
        last = g.Unsqueeze(g.Min(last, float(TILE)), [1, 2, 3])
        position = g.Min(g.Max(position, 0.0), last) * 0.5 + 1
        distance = g.Abs(position - np.arange(NODES, dtype=np.float32))
        far, near = (g.Relu(reach - distance) for reach in (2, 1))
        far, near = (part * part * part for part in (far, near))
        return far * (1 / 6) - near * (2 / 3)

    def is_even(self) -> Value:
        """Return whether all spare pixels are at the end of the last run, (1,)."""
        g = self.graph
        last = g.Slice(self.runs, [-1], [1 << 30], [0])
        return g.Equal(self.padded - (self.pieces * self.side - last), self.size)

    def places(self) -> Value:
        """Return the index of each pixel among the pixels of all blocks, (size,)."""
        g = self.graph
        length = g.Squeeze(self.pieces * self.side)
        is_pixel = g.Less(g.Range(0, length, 1), g.Unsqueeze(self.runs, [1]))
        places = g.Range(0, g.Squeeze(self.padded), 1)
        return g.Compress(places, g.Reshape(is_pixel, [-1]), axis=0)

    def shrink(self, image: Value, places: Value, axis: int) -> Value:
        """Reduce the rendered pixels, at `places`, to output pixels: means weighted by shares of the length."""
        g = self.graph
        begin = g.Unsqueeze(g.Range(0, g.Squeeze(self.output), 1) * self.size, [1])
        longest = (self.size + (self.output - 1)) // self.output + 1
        lines = begin // self.output + g.Range(0, g.Squeeze(longest), 1)
        ends = g.Min(begin + self.size, (lines + 1) * self.output)
        shares = ends - g.Max(begin, lines * self.output)
        shares = g.Max(shares, 0).astype(FLOAT) / self.size.astype(FLOAT)
        if axis == 2:
            shares = g.Unsqueeze(shares, [2])
        pixels = g.Gather(image, places[g.Min(lines, self.size - 1)], axis=axis)
        return g.ReduceSum(pixels * shares, [axis + 1], keepdims=0)


def _bounds(g: Graph, length: int, ends: tuple[Value, Value] | None) -> tuple[Value, Value]:
    """Return the start and the length of the part of the scene that is rendered, (1,) each, in parts of a pixel."""
    if ends is None:
        return g.constant([0]), g.constant([length * _PARTS])
    start, end = ((bound * _PARTS).astype(INT64) for bound in ends)
    return start, g.Max(end - start, 1)


class Interpolator:
    """Interpolate windows of n x n values around tiles at the pixels of their blocks; all are stored by columns."""

    def __init__(self, down: Axis, across: Axis, rows: Value, columns: Value, side: int) -> None:
        """`rows` and `columns` are the weights of a window's values, (V, pieces, side, n); n is `side`."""
        self.graph = down.graph
        self.rows = self.graph.Transpose(rows, perm=[0, 1, 3, 2])
        self.columns = columns
        self.side = side
        self.pixels = down.side * across.side  # P
        self.is_native = self.graph.And(down.is_native, across.is_native)
        self.is_aligned = self.graph.And(down.is_aligned, across.is_aligned)

    def blocks(self, windows: Value, row: Value, col: Value, shape: tuple[int, int]) -> Value:
        """Interpolate windows, (T, K, n, n), at the blocks of tiles in `row` and `col`, (T,): (T, blocks, *shape, P).

        K is the product of `shape`.
        """
        g, n = self.graph, self.side
        halves = g.Reshape(windows, [0, 1, -1, n]) @ self.rows[row]  # [T, pieces, K n, side]
        halves = g.Reshape(halves, [0, 0, 1, math.prod(shape), n, -1])
        values = g.Unsqueeze(self.columns[col], [1, 3]) @ halves  # [T, pieces, pieces, K, side, side]
        return g.Reshape(values, g.Concat([0, -1, *shape], self.pixels, axis=0))
