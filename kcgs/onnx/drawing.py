"""Blocks drawn: log w is a polynomial in the pixel.

So the weights of a list of Gaussians are one matrix product with the monomials, and its colours another with the
weights.
"""

from __future__ import annotations

import numpy as np

from .axis import Axis
from .graph import Graph, Value
from .shares import Windows
from .stored import Stored

F32 = np.float32


class Drawing:
    """Draws groups of tiles; what they have in common is made once."""

    def __init__(self, graph: Graph, stored: Stored, down: Axis, across: Axis, cutoff: float) -> None:
        """Take what all groups share.

        Args:
            graph: the graph.
            stored: the Gaussians of all groups.
            down: rows.
            across: columns.
            cutoff: of weights.
        """
        g = self.g = graph
        self.stored, self.down, self.across, self.cutoff = stored, down, across, cutoff
        self.channels = stored.channels
        self.pixels = g("Mul", across.side, down.side)  # P
        y, x = g("Unsqueeze", down.steps, g.constant([0])), g("Unsqueeze", across.steps, g.constant([1]))
        sides = g("Concat", across.side, down.side, axis=0)
        x, y = g("Expand", x, sides), g("Expand", y, sides)
        flat = g.constant([-1])
        x, y = g("Reshape", x, flat), g("Reshape", y, flat)
        one = g("Add", g("Mul", x, F32(0)), F32(1))
        rows = (one, x, y, g("Mul", x, x), g("Mul", x, y), g("Mul", y, y))
        self.monomials = g("Concat", *[g("Unsqueeze", r, g.constant([0])) for r in rows], axis=0)  # [6, P]

    def group(self, number: int, blocks: Value, slots: Value, windows: Windows | None) -> Value:
        """Draw the blocks of a group.

        Args:
            number: of the group.
            blocks: (B,), by number: row times columns plus column.
            slots: (B,), the tile of each, by place in the group.
            windows: memberships, where any tile has several regions.

        Returns:
            (B, C, P).
        """
        g = self.g
        group = self.stored.groups[number]
        form, colors = self.stored.form(number), self.stored.colors(number)
        row, col = g("Div", blocks, self.across.blocks), g("Mod", blocks, self.across.blocks)
        oy, ox = (
            g("Reshape", g("Gather", axis.origins, at), g.constant([-1, 1, 1]))
            for axis, at in ((self.down, row), (self.across, col))
        )
        form = g("Gather", form, slots)  # [B, L, 8]
        e1, k1, e2, k3, k4, shape = g.apply("Split", [form, g.constant([1, 1, 1, 1, 1, 3])], 6, axis=2)
        z1 = g("Add", e1, g("Mul", k1, ox))
        z2 = g("Add", g("Add", e2, g("Mul", k3, ox)), g("Mul", k4, oy))
        exponent = self._squares(z1, k1, z2, k3, k4) if group.narrow else self._polynomial(z1, k1, z2, k3, k4, shape)
        weight = g("Exp", exponent)
        if self.cutoff > 0:
            # keeps what is greater; the least weight that is drawn is the cutoff itself
            weight = g("ThresholdedRelu", weight, alpha=float(np.nextafter(F32(self.cutoff), F32(0))))
        drawn = g("MatMul", g("Gather", colors, slots), weight)  # [B, K * C, P]
        if windows is None or group.regions == 1:
            return drawn
        drawn = g("Reshape", drawn, g.constant([0, group.regions, self.channels, -1]))
        shares = windows.shares(group.tiles, group.regions, slots, row, col)  # [B, K, 1, P]
        return g("ReduceSum", g("Mul", drawn, shares), g.constant([1]), keepdims=0)

    def _polynomial(self, z1: Value, k1: Value, z2: Value, k3: Value, k4: Value, shape: Value) -> Value:
        """Log w as coefficients times monomials."""
        g, twice = self.g, F32(-2)
        constant = g("Neg", g("Add", g("Mul", z1, z1), g("Mul", z2, z2)))
        along = g("Mul", twice, g("Add", g("Mul", z1, k1), g("Mul", z2, k3)))
        down = g("Mul", twice, g("Mul", z2, k4))
        return g("MatMul", g("Concat", constant, along, down, shape, axis=2), self.monomials)

    def _squares(self, z1: Value, k1: Value, z2: Value, k3: Value, k4: Value) -> Value:
        """Log w as a sum of squares, which no rounding of large coefficients harms."""
        g = self.g
        one, x, y = (
            g("Slice", self.monomials, g.constant([i]), g.constant([i + 1]), g.constant([0])) for i in range(3)
        )
        first = g("Add", z1, g("Mul", k1, x))  # [B, L, P]
        second = g("MatMul", g("Concat", z2, k3, k4, axis=2), g("Concat", one, x, y, axis=0))
        return g("Neg", g("Add", g("Mul", first, first), g("Mul", second, second)))
