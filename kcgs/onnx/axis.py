"""The pixels of the output along one side of the scene, and their blocks: for `blocks`, `grids` and `membership`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kcgs.kernels.tiles import TILE

from .graph import FLOAT, INT64, Graph, Value

# nodes, two pixels apart, that the cubic B-splines of a tile read
NODES = TILE // 2 + 3
# places between two pixel centres that hard contours are sampled at, as in `RegionMap.resize`
_OFFSETS = 1024
# integers per pixel: in these parts the ends of a view are rounded
_PARTS = 1 << 20


@dataclass(frozen=True)
class Axis:
    """Rows, or columns, of the output.

    Pixels whose centres lie in the same tile of the scene make a run; runs are cut into blocks of one length, at most
    `TILE` pixels, with some pixels to spare at the ends of runs. Places are integers over a common denominator: pixel i
    is at (2 n start + (2 i + 1) (end - start)) / 2 n, so that a contour's pixels fall on the same side everywhere, and
    not all runtimes have float64. Where pixels of the output are larger than those of the scene, more are rendered
    first, as many as the scene has there and at most twice those of the whole; `shrink` then takes means.
    """

    graph: Graph
    length: int  # pixels of the scene
    output: Value  # (1,) int64, pixels of the output
    size: Value  # (1,) int64, pixels that are rendered
    parts: Value  # (1,) int64, integers of a place per pixel of the scene
    step: Value  # (1,) float32, pixels of the scene per rendered pixel
    side: Value  # (1,) int64, pixels of a block
    blocks: Value  # (1,) int64, number of blocks
    tile: Value  # (blocks,), of each block
    place: Value  # (size,), of each pixel among those of all blocks
    local: Value  # (blocks, side) int64, pixel centres from the corner of the block's tile, in parts
    steps: Value  # (side,), pixel centres from the middle of a block, where polynomials are rounded least
    origins: Value  # (blocks,), middles of blocks from the centre of their tile

    def sampling(self, soft: bool) -> Value:
        """Bilinear weights of a window, a tile and the pixels around it, per block: (blocks, side, window).

        Where contours are hard, offsets are such that no two labels weigh the same.
        """
        g = self.graph
        if soft:
            position = self.local.astype(FLOAT) / self.parts.astype(FLOAT) + 0.5
            # a view may go beyond the scene, where the values of the border are held
            first = g.Unsqueeze(1 - self.tile * TILE, [1])
            for clip, end in ((g.Max, 0), (g.Min, self.length - 1)):
                position = clip(position, (first + end).astype(FLOAT))
            position = g.Unsqueeze(position, [2])
        else:
            # from the first pixel's centre, in halves of a part
            halves = g.Unsqueeze(self.local, [2]) * 2 + self.parts
            offset = g.Max(halves * (_OFFSETS // 2) // self.parts, 0)
            offset = g.Min(offset, (TILE + 1) * _OFFSETS - 1)
            position = (offset * 2 + 1).astype(FLOAT) / (2 * _OFFSETS)
        window = np.arange(TILE + 2, dtype=np.float32)
        return g.Relu(1 - g.Abs(position - window))

    def spline(self) -> Value:
        """Weights of a tile's nodes, two pixels apart, at the pixels of each block, (blocks, side, NODES).

        Beyond the scene the values of its border are held.
        """
        g = self.graph
        position = self.local.astype(FLOAT) / self.parts.astype(FLOAT)
        last = (self.length - self.tile * TILE).astype(FLOAT)
        last = g.Unsqueeze(g.Min(last, float(TILE)), [1])
        position = g.Min(g.Max(position, 0.0), last)
        position = g.Unsqueeze(position, [2]) * 0.5 + 1
        distance = g.Abs(position - np.arange(NODES, dtype=np.float32))
        far, near = (g.Relu(reach - distance) for reach in (2, 1))
        far, near = (part * part * part for part in (far, near))
        return far * (1 / 6) - near * (2 / 3)

    def shrink(self, image: Value, axis: int) -> Value:
        """Reduce the rendered pixels to those of the output: each is the mean over its share of the length."""
        g = self.graph
        begin = g.Unsqueeze(g.Range(0, g.Squeeze(self.output), 1) * self.size, [1])
        longest = (self.size + (self.output - 1)) // self.output + 1
        lines = begin // self.output + g.Range(0, g.Squeeze(longest), 1)
        ends = g.Min(begin + self.size, (lines + 1) * self.output)
        shares = ends - g.Max(begin, lines * self.output)
        shares = g.Max(shares, 0).astype(FLOAT) / self.size.astype(FLOAT)
        if axis == 2:
            shares = g.Unsqueeze(shares, [2])
        pixels = g.Gather(image, g.Min(lines, self.size - 1), axis=axis)
        return g.ReduceSum(pixels * shares, [axis + 1], keepdims=0)


def make_axis(g: Graph, output: Value, length: int, ends: tuple[Value, Value] | None = None) -> Axis:
    """Place so many pixels, (1,), along `length` pixels of the scene, or along the part between `ends`, (1,) each."""
    if ends is None:
        start, extent = g.constant([0]), g.constant([length * _PARTS])
    else:
        start, end = ((bound * _PARTS).astype(INT64) for bound in ends)
        extent = end - start
    # rounded up, but for what rounding of the ends may add; a view far beyond the scene has no more to show
    pixels = (extent + (_PARTS - 1 - _PARTS // 256)) // _PARTS
    size = g.Max(output, g.Min(pixels, 2 * length))
    parts = size * (2 * _PARTS)
    step = extent.astype(FLOAT) / (size * _PARTS).astype(FLOAT)
    pixel = g.Range(0, g.Squeeze(size), 1)
    centre = (pixel * 2 + 1) * extent + size * 2 * start
    # bounded once it is small: onnxruntime 1.31 takes the wrong one of two int64 beyond 32 bits
    tiles = -(-length // TILE)
    tile = g.Min(g.Max(centre // (parts * TILE), 0), tiles - 1)
    rank, begins, side = _cut_blocks(g, pixel, tile, tiles)
    first = g.Compress(pixel, begins, axis=0)  # of each block
    blocks = g.Shape(first)
    block_tile = tile[first]
    place = (g.CumSum(begins.astype(INT64), 0) - 1) * side + rank

    # pixels to spare at the end of a block repeat the last pixel of the image
    within = g.Range(0, g.Squeeze(side), 1)
    pixels = g.Min(g.Unsqueeze(first, [1]) + within, size - 1)  # (blocks, side)
    corner = block_tile * TILE * parts
    local = centre[pixels] - g.Unsqueeze(corner, [1])
    middle = (side - 1).astype(FLOAT) * 0.5
    steps = (within.astype(FLOAT) - middle) * step
    begin = (centre[first] - corner).astype(FLOAT) / parts.astype(FLOAT)
    origins = begin - TILE / 2 + middle * step
    return Axis(g, length, output, size, parts, step, side, blocks, block_tile, place, local, steps, origins)


def _cut_blocks(g: Graph, pixel: Value, tile: Value, tiles: int) -> tuple[Value, Value, Value]:
    """Cut the pixels of each tile into blocks: the place of each pixel in its block, whether it is the first, the side.

    All blocks are of one side, (1,), as even as the longest run of pixels allows.
    """
    numbers = g.constant(np.arange(tiles)[:, None])
    counts = g.ReduceSum(g.Equal(numbers, tile).astype(INT64), [1], keepdims=0)
    starts = g.CumSum(counts, 0, exclusive=1)
    longest = g.ReduceMax(counts, keepdims=1)
    pieces = (longest + (TILE - 1)) // TILE
    side = (longest + (pieces - 1)) // pieces
    rank = (pixel - starts[tile]) % side
    return rank, g.Equal(rank, 0), side
