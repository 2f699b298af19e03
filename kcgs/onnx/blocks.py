"""The image of a decoder, rendered in blocks: log w is a polynomial in the pixel.

So the weights of a list of Gaussians are one matrix product with the monomials, and its colours another with the
weights. docs/onnx.md has the whole graph.
"""

from __future__ import annotations

import numpy as np

from .axis import Axis
from .graph import INT64, Graph, Value
from .stored import Stored
from .windows import Windows

F32 = np.float32


class Blocks:
    """Renders blocks, of rows `down` and columns `across`, group by group; what groups have in common is made once."""

    def __init__(self, graph: Graph, stored: Stored, down: Axis, across: Axis, cutoff: float) -> None:
        g = self.g = graph
        self.stored, self.down, self.across, self.cutoff = stored, down, across, cutoff
        self.layout, self.channels = stored.layout, stored.channels
        self.pixels = g("Mul", across.side, down.side)  # P
        y, x = g("Unsqueeze", down.steps, g.constant([0])), g("Unsqueeze", across.steps, g.constant([1]))
        sides = g("Concat", across.side, down.side, axis=0)
        x, y = g("Expand", x, sides), g("Expand", y, sides)
        flat = g.constant([-1])
        x, y = g("Reshape", x, flat), g("Reshape", y, flat)
        one = g("Add", g("Mul", x, F32(0)), F32(1))
        rows = (one, x, y, g("Mul", x, x), g("Mul", x, y), g("Mul", y, y))
        self.monomials = g("Concat", *[g("Unsqueeze", r, g.constant([0])) for r in rows], axis=0)  # [6, P]

    def render(self, windows: Windows | None) -> Value:
        """Render the image, (1, C, H, W); windows are needed where any tile has several regions."""
        g, tiles, groups = self.g, self.layout.tiles, self.layout.groups
        group_of = np.full(len(tiles.regions), len(groups))
        slot_of = np.zeros(len(tiles.regions), np.int64)
        for number, group in enumerate(groups):
            group_of[group.tiles], slot_of[group.tiles] = number, np.arange(len(group.tiles))
        one = g.constant([1])
        tile = g("Add", g("Unsqueeze", g("Mul", self.down.tile, tiles.cols), one), self.across.tile)
        tile = g("Reshape", tile, g.constant([-1]))
        group_of_block = g("Cast", g("Gather", g.whole(group_of), tile), to=INT64)
        slots = g("Cast", g("Gather", g.whole(slot_of), tile), to=INT64)
        order, starts, stops, index = self._sort(group_of_block)
        rendered = []
        for number, group in enumerate(groups):
            start, stop = (g("Gather", ends, g.constant([number])) for ends in (starts, stops))
            chosen = g("Slice", order, start, stop, g.constant([0]))
            slot = g("Min", g("Gather", slots, chosen), len(group.tiles) - 1)
            rendered.append(self._render_group(number, chosen, slot, windows))
        # one black block for all that nothing touches
        black = g("Concat", g.constant([1, self.channels]), self.pixels, axis=0)
        rendered.append(g("Expand", F32(0), black))
        return self._assemble(g("Gather", g("Concat", *rendered, axis=0), index))

    def _sort(self, group: Value) -> tuple[Value, Value, Value, Value]:
        """Sort blocks by group, (NB,); return them, one to spare, groups' begins, their ends, where each is rendered.

        A group without a block renders one that nobody looks at: tensors without elements are not for every runtime.
        """
        g, count = self.g, len(self.layout.groups)
        total = g("Shape", group)
        key = g("Add", g("Mul", group, total), g("Range", np.int64(0), g("Squeeze", total), np.int64(1)))
        order = g.apply("TopK", [key, total], 2, largest=0, axis=0)[1]
        rank = g.apply("TopK", [order, total], 2, largest=0, axis=0)[1]
        members = g("Cast", g("Equal", g.constant(np.arange(count + 1)[:, None]), group), to=INT64)
        counts = g("ReduceSum", members, g.constant([1]), keepdims=0)
        rendered = g("Max", counts, np.array([1] * count + [0]))
        starts, firsts = (g("CumSum", n, np.int64(0), exclusive=1) for n in (counts, rendered))
        index = g("Add", rank, g("Gather", g("Sub", firsts, starts), group))
        black = g("Gather", firsts, g.constant([count]))
        index = g("Min", index, black)
        return g("Concat", order, g.constant([0]), axis=0), starts, g("Add", starts, rendered), index

    def _render_group(self, number: int, blocks: Value, slots: Value, windows: Windows | None) -> Value:
        """Render blocks (B,) of a group, (B, C, P); `slots`, (B,), are their tiles by place in the group."""
        g, group = self.g, self.layout.groups[number]
        whitened, colors = self.stored.whitened(number), self.stored.colors(number)
        row, col = g("Div", blocks, self.across.blocks), g("Mod", blocks, self.across.blocks)
        oy, ox = (
            g("Reshape", g("Gather", axis.origins, block), g.constant([-1, 1, 1]))
            for axis, block in ((self.down, row), (self.across, col))
        )
        whitened = g("Gather", whitened, slots)  # [B, L, 8]
        e1, k1, e2, k3, k4, squares = g.apply("Split", [whitened, g.constant([1, 1, 1, 1, 1, 3])], 6, axis=2)
        z1 = g("Add", e1, g("Mul", k1, ox))
        z2 = g("Add", g("Add", e2, g("Mul", k3, ox)), g("Mul", k4, oy))
        exponent = self._squares(z1, k1, z2, k3, k4) if group.narrow else self._polynomial(z1, k1, z2, k3, k4, squares)
        weight = g("Exp", exponent)
        if self.cutoff > 0:
            # keeps what is greater; the least weight that counts is the cutoff itself
            weight = g("ThresholdedRelu", weight, alpha=float(np.nextafter(F32(self.cutoff), F32(0))))
        values = g("MatMul", g("Gather", colors, slots), weight)  # [B, K * C, P]
        if windows is None or group.regions == 1:
            return values
        values = g("Reshape", values, g.constant([0, group.regions, self.channels, -1]))
        weights = windows.weights(group, slots, row, col)  # [B, K, 1, P]
        return g("ReduceSum", g("Mul", values, weights), g.constant([1]), keepdims=0)

    def _polynomial(self, z1: Value, k1: Value, z2: Value, k3: Value, k4: Value, squares: Value) -> Value:
        """Log w as coefficients times monomials."""
        g, twice = self.g, F32(-2)
        constant = g("Neg", g("Add", g("Mul", z1, z1), g("Mul", z2, z2)))
        along = g("Mul", twice, g("Add", g("Mul", z1, k1), g("Mul", z2, k3)))
        down = g("Mul", twice, g("Mul", z2, k4))
        return g("MatMul", g("Concat", constant, along, down, squares, axis=2), self.monomials)

    def _squares(self, z1: Value, k1: Value, z2: Value, k3: Value, k4: Value) -> Value:
        """Log w as a sum of squares, which no rounding of large coefficients harms."""
        g = self.g
        one, x, y = (
            g("Slice", self.monomials, g.constant([i]), g.constant([i + 1]), g.constant([0])) for i in range(3)
        )
        first = g("Add", z1, g("Mul", k1, x))  # [B, L, P]
        second = g("MatMul", g("Concat", z2, k3, k4, axis=2), g("Concat", one, x, y, axis=0))
        return g("Neg", g("Add", g("Mul", first, first), g("Mul", second, second)))

    def _assemble(self, blocks: Value) -> Value:
        """Put the blocks together and leave out the pixels to spare: columns, then rows, each a stretch of memory."""
        g, down, across, channels = self.g, self.down, self.across, self.channels
        split = g("Concat", down.blocks, across.blocks, g.constant([channels]), across.side, down.side, axis=0)
        image = g("Transpose", g("Reshape", blocks, split), perm=[1, 3, 2, 0, 4])
        width, height = (g("Mul", axis.blocks, axis.side) for axis in (across, down))
        image = g("Reshape", image, g("Concat", width, g.constant([1, channels]), height, axis=0))
        image = g("Transpose", g("Gather", image, across.place, axis=0), perm=[1, 2, 3, 0])
        return g("Gather", image, down.place, axis=2)
