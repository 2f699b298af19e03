"""The pixels of the output along one side of the scene, and their blocks: for `blocks`, `grids` and `membership`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kcgs.maps import TILE

from .graph import FLOAT, INT64, Graph, Value

# nodes, two pixels apart, that the cubic B-splines of a tile read
NODES = TILE // 2 + 3
# integers per pixel: in these parts the ends of a view are rounded
_PARTS = 1 << 20


@dataclass(frozen=True)
class Axis:
    """Rows, or columns, of the output.

    Pixels whose centres lie in the same tile of the scene make a run. Every run is cut into the same number of blocks,
    of one length, at most `TILE` pixels, with some pixels to spare at the end of shorter runs. Places are integers over
    a common denominator: pixel i is at (2 n start + (2 i + 1) (end - start)) / 2 n, so that a contour's pixels fall on
    the same side everywhere, and not all runtimes have float64. Where pixels of the output are larger than those of the
    scene, more are rendered first, as many as the scene has there and at most twice those of the whole; `shrink` then
    takes means.
    """

    graph: Graph
    length: int  # pixels of the scene
    output: Value  # (1,) int64, pixels of the output
    size: Value  # (1,) int64, pixels that are rendered
    parts: Value  # (1,) int64, integers of a place per pixel of the scene
    is_native: Value  # (1,) bool, whether the pixels are those of the scene, and a tile one block
    is_aligned: Value  # (1,) bool, whether pixels are as large as those of the scene, and at their places
    step: Value  # (1,) float32, pixels of the scene per rendered pixel
    tile: Value  # (V,), tiles with a run, one after the other; a constant where all of the scene is rendered
    runs: Value  # (V,), pixels of each run
    pieces: Value  # (1,), blocks of a run
    side: Value  # (1,), pixels of a block
    local: Value  # (V, pieces, side) int64, pixel centres from the corner of the tile, in parts
    steps: Value  # (side,), pixel centres from the middle of a block, where polynomials are rounded least
    origins: Value  # (V, pieces), middles of blocks from the centre of their tile

    @property
    def padded(self) -> Value:
        """Pixels of all blocks, (1,)."""
        return self.graph.Shape(self.runs) * self.pieces * self.side

    def sampling(self) -> Value:
        """Bilinear weights of a window, a tile and the pixels around it, (V, pieces, side, window)."""
        g = self.graph
        position = g.Unsqueeze(self.local, [3]).astype(FLOAT) / self.parts.astype(FLOAT) + 0.5
        # a view may go beyond the scene, where the values of the border are held
        first = g.Unsqueeze(1 - self.tile * TILE, [1, 2, 3])
        for clip, end in ((g.Max, 0), (g.Min, self.length - 1)):
            position = clip(position, (first + end).astype(FLOAT))
        return g.Relu(1 - g.Abs(position - np.arange(TILE + 2, dtype=np.float32)))

    def spline(self) -> Value:
        """Weights of a tile's nodes, two pixels apart, at the pixels of each block, (V, pieces, side, NODES).

        Beyond the scene the values of its border are held.
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
        """Whether pixels to spare lie only behind the last run, (1,)."""
        g = self.graph
        last = g.Slice(self.runs, [-1], [1 << 30], [0])
        return g.Equal(self.padded - (self.pieces * self.side - last), self.size)

    def places(self) -> Value:
        """Where each pixel is among those of all blocks, (size,)."""
        g = self.graph
        length = g.Squeeze(self.pieces * self.side)
        is_pixel = g.Less(g.Range(0, length, 1), g.Unsqueeze(self.runs, [1]))
        places = g.Range(0, g.Squeeze(self.padded), 1)
        return g.Compress(places, g.Reshape(is_pixel, [-1]), axis=0)

    def shrink(self, image: Value, places: Value, axis: int) -> Value:
        """Reduce the rendered pixels, at `places`, to those of the output: means over their shares of the length."""
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


def make_axis(g: Graph, output: Value, length: int, ends: tuple[Value, Value] | None = None) -> Axis:
    """Place so many pixels, (1,), along `length` pixels of the scene, or along the part between `ends`, (1,) each."""
    if ends is None:
        start, extent = g.constant([0]), g.constant([length * _PARTS])
    else:
        start, end = ((bound * _PARTS).astype(INT64) for bound in ends)
        extent = g.Max(end - start, 1)
    # rounded up, but for what rounding of the ends may add; a view far beyond the scene has no more to show
    pixels = (extent + (_PARTS - 1 - _PARTS // 256)) // _PARTS
    size = g.Max(output, g.Min(pixels, 2 * length))
    parts = size * (2 * _PARTS)
    step = extent.astype(FLOAT) / (size * _PARTS).astype(FLOAT)
    shift = size * 2 * start
    tiles = -(-length // TILE)
    if ends is None:
        tile = g.constant(np.arange(tiles))
    else:
        centres = (extent + shift, (size * 2 - 1) * extent + shift)  # of the first and the last pixel
        # bounded once it is small: onnxruntime 1.31 takes the wrong one of two int64 beyond 32 bits
        first, last = (g.Squeeze(g.Min(g.Max(c // (parts * TILE), 0), tiles - 1)) for c in centres)
        tile = g.Range(first, last + 1, 1)
    corner = tile * TILE * parts
    # the first pixel of a run is the first whose centre is not left of the corner; those left of the scene are tile 0's
    begin = g.Max((corner - shift + extent - 1) // (extent * 2), 0) * g.Min(tile, 1)
    end = g.Concat(g.Slice(begin, [1], [1 << 30], [0]), size, axis=0)
    runs = end - begin
    longest = g.ReduceMax(runs, keepdims=1)
    pieces = (longest + (TILE - 1)) // TILE
    side = (longest + (pieces - 1)) // pieces
    is_aligned = g.And(g.Equal(start % _PARTS, 0), g.Equal(extent, size * _PARTS))
    is_native = g.And(g.And(g.Equal(start, 0), is_aligned), g.Equal(side, TILE))

    within = g.Reshape(g.Range(0, g.Squeeze(pieces * side), 1), g.Concat([1], pieces, side, axis=0))
    axes = g.constant([1, 2])
    pixel = g.Unsqueeze(begin, axes) + within
    local = (pixel * 2 + 1) * extent + (shift - g.Unsqueeze(corner, axes))
    middle = (side - 1).astype(FLOAT) * 0.5
    steps = (g.Range(0, g.Squeeze(side), 1).astype(FLOAT) - middle) * step
    origins = g.Gather(local, 0, axis=2).astype(FLOAT) / parts.astype(FLOAT) + (middle * step - TILE / 2)
    return Axis(
        g, length, output, size, parts, is_native, is_aligned, step, tile, runs, pieces, side, local, steps, origins
    )


class Interpolator:
    """Interpolates windows of n x n values around tiles at the pixels of their blocks, all column by column."""

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
        """Interpolate windows, (T, K, n, n), in the blocks of tiles at `row` and `col`, (T,): (T, blocks, *shape, P).

        K is the product of `shape`.
        """
        g, n = self.graph, self.side
        halves = g.Reshape(windows, [0, 1, -1, n]) @ self.rows[row]  # [T, pieces, K n, side]
        halves = g.Reshape(halves, [0, 0, 1, math.prod(shape), n, -1])
        values = g.Unsqueeze(self.columns[col], [1, 3]) @ halves  # [T, pieces, pieces, K, side, side]
        return g.Reshape(values, g.Concat([0, -1, *shape], self.pixels, axis=0))
