"""The image of a decoder, rendered in blocks: log w is a polynomial in the pixel.

So the weights of a list of Gaussians are one matrix product with the monomials, and its colours another with the
weights. docs/onnx.md has the whole graph.
"""

from __future__ import annotations

import numpy as np

from .axis import Axis
from .graph import INT64, Graph, Value
from .layout import Group, Integers
from .planes import Planes
from .stored import Stored, monomials, weigh
from .windows import Windows

F32 = np.float32
# of the monomials 1, x, y, xx, xy, yy at (x + a, y + b): which of a, b, aa, ab, bb, which of them, times which, factor
_SHIFT = (
    *((0, 1, 0, 1), (1, 2, 0, 1), (2, 3, 0, 1), (3, 4, 0, 1), (4, 5, 0, 1)),
    *((0, 3, 1, 2), (1, 4, 1, 1), (0, 4, 2, 1), (1, 5, 2, 2)),
)


class Blocks:
    """Renders blocks, of rows `down` and columns `across`, group by group; what groups have in common is made once."""

    def __init__(self, graph: Graph, stored: Stored, down: Axis, across: Axis, cutoff: float) -> None:
        g = self.g = graph
        self.stored, self.down, self.across, self.cutoff = stored, down, across, cutoff
        self.tiles, self.channels = stored.layout.tiles, stored.channels
        self.groups = [group for group in stored.layout.groups if not group.nodes]
        self.pixels = g("Mul", across.side, down.side)  # P
        self.monomials = monomials(g, across.steps, down.steps)
        self.shifts = self._shifts()

    def _shifts(self) -> Value:
        """Make what turns coefficients around a tile's centre into those around each block's middle, (NB, 6, 6)."""
        g = self.g
        sides = g("Concat", self.down.blocks, self.across.blocks, g.constant([1]), axis=0)
        x, y = (
            g("Expand", g("Reshape", axis.origins, g.constant(shape)), sides)
            for axis, shape in ((self.across, [1, -1, 1]), (self.down, [-1, 1, 1]))
        )
        columns = (x, y, g("Mul", x, x), g("Mul", x, y), g("Mul", y, y))
        powers = g("Reshape", g("Concat", *columns, axis=2), g.constant([-1, 5]))
        basis = np.zeros((5, 6, 6), F32)
        for power, row, column, factor in _SHIFT:
            basis[power, row, column] = factor
        moved = g("Reshape", g("MatMul", powers, basis.reshape(5, 36)), g.constant([-1, 6, 6]))
        return g("Add", moved, np.eye(6, dtype=F32))

    def render(self, windows: Windows | None, planes: Planes | None) -> Value:
        """Render the image, (1, C, H, W); windows are needed where any tile has several regions."""
        g, groups = self.g, self.groups
        tile = g("Unsqueeze", g("Mul", self.down.tile, self.tiles.cols), g.constant([1]))
        tile = g("Add", tile, self.across.tile)
        tile = g("Reshape", tile, g.constant([-1]))
        group_of_block = g("Cast", g("Gather", self.stored.group_of, tile), to=INT64)
        group_of_block = g("Min", group_of_block, len(groups))
        slots = g("Cast", g("Gather", self.stored.slot_of, tile), to=INT64)
        order, *bounds, index = self._sort(group_of_block)
        starts, stops = (g.split(ends, [1] * (len(groups) + 1)) for ends in bounds)
        rendered = []
        for number, group in enumerate(groups):
            chosen = g("Slice", order, starts[number], stops[number], g.constant([0]))
            slot = g("Min", g("Gather", slots, chosen), len(group.tiles) - 1)
            rendered.append(self._render_group(number, chosen, slot, windows, planes))
        # one black block for all that nothing touches
        black = g("Concat", g.constant([1, self.channels]), self.pixels, axis=0)
        rendered.append(g("Expand", F32(0), black))
        return self._assemble(g("Concat", *rendered, axis=0), index, planes)

    def _sort(self, group: Value) -> tuple[Value, Value, Value, Value]:
        """Sort blocks by group, (NB,); return them, one to spare, groups' begins, their ends, where each is rendered.

        A group without a block renders one that nobody looks at: tensors without elements are not for every runtime.
        """
        g, count = self.g, len(self.groups)
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

    def _render_group(
        self, number: int, blocks: Value, slots: Value, windows: Windows | None, planes: Planes | None
    ) -> Value:
        """Render blocks (B,) of a group, (B, C, P); `slots`, (B,), are their tiles by place in the group."""
        g, group = self.g, self.groups[number]
        regions = None if group.regions == 1 else g.whole(self._regions(group))
        colors = self.stored.colors(number, regions)
        coefficients = g("Gather", self.stored.coefficients(number), slots)  # [B, L, 6]
        exponent = (self._squares if group.narrow else self._polynomial)(coefficients, blocks)
        values = g("MatMul", g("Gather", colors, slots), weigh(g, exponent, self.cutoff))  # [B, K * C, P]
        if windows is None or regions is None:
            return values
        row, col = g("Div", blocks, self.across.blocks), g("Mod", blocks, self.across.blocks)
        if planes is not None:
            values = g("Add", values, planes.blocks(number, regions, slots, row, col))
        values = g("Reshape", values, g.constant([0, group.regions, self.channels, -1]))
        weights = windows.weights(group, slots, row, col)  # [B, K, 1, P]
        return g("ReduceSum", g("Mul", values, weights), g.constant([1]), keepdims=0)

    def _regions(self, group: Group) -> Integers:
        """Regions of a group's tiles, (T, K), filled up with one that nothing has."""
        found = [self.tiles.regions[tile] for tile in group.tiles.tolist()]
        beyond = 1 + max(max(regions) for regions in self.tiles.regions)
        return np.array([regions + [beyond] * (group.regions - len(regions)) for regions in found])

    def _polynomial(self, coefficients: Value, blocks: Value) -> Value:
        """Log w as coefficients times monomials."""
        g = self.g
        return g("MatMul", g("MatMul", coefficients, g("Gather", self.shifts, blocks)), self.monomials)

    def _squares(self, coefficients: Value, blocks: Value) -> Value:
        """Log w as a sum of squares, which no rounding of large coefficients harms."""
        g, three = self.g, self.g.constant([3])
        shift = g("Slice", g("Gather", self.shifts, blocks), g.constant([0, 0]), g.constant([3, 3]), g.constant([1, 2]))
        monomials = g("Slice", self.monomials, g.constant([0]), three, g.constant([0]))
        parts = g.apply("Split", [coefficients, g.constant([3, 3])], 2, axis=2)
        z1, z2 = (g("MatMul", g("MatMul", part, shift), monomials) for part in parts)
        return g("Neg", g("Add", g("Mul", z1, z1), g("Mul", z2, z2)))

    def _assemble(self, blocks: Value, index: Value, planes: Planes | None) -> Value:
        """Put the blocks (n, C, P) together, and add the planes; then leave out the pixels to spare."""
        g, down, across, channels = self.g, self.down, self.across, self.channels
        # stretches of memory: of a block's channel and column, all its rows
        stretches = g("Reshape", blocks, g("Concat", g.constant([-1]), down.side, axis=0))
        area = g("Mul", across.side, g.constant([channels]))
        first = g("Mul", g("Reshape", index, g("Concat", down.blocks, across.blocks, axis=0)), area)
        first = g("Gather", first, g("Div", across.place, across.side), axis=1)
        first = g("Add", first, g("Mod", across.place, across.side))
        one, channel = g.constant([1]), np.arange(channels)[:, None]
        stretch = g("Add", g("Unsqueeze", first, one), g("Mul", g.constant(channel), across.side))
        image = g("Gather", stretches, stretch)  # [blocks, C, width, side]: blocks are read one row of them at a time
        image = g("Transpose", image, perm=[0, 1, 3, 2])
        if planes is not None:
            image = g("Add", image, planes.grid())
        image = g("Reshape", image, g("Concat", g.constant([-1]), across.size, axis=0))
        place = g("Add", g("Mul", g("Div", down.place, down.side), channels), g.constant(channel))
        place = g("Add", g("Mul", place, down.side), g("Mod", down.place, down.side))
        return g("Gather", image, g("Unsqueeze", place, g.constant([0])))
