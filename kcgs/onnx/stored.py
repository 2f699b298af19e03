"""What a graph stores of the Gaussians, and how that is unfolded: once, when the decoder is loaded."""

from __future__ import annotations

import math

import numpy as np

from kcgs.kernels.tiles import TILE
from kcgs.kernels.whitened import Z_LIMIT

from .graph import FLOAT, Graph, Value
from .layout import Layout

F32 = np.float32
_ROOT = math.sqrt(0.5)


class Stored:
    """The entries of all groups, one after the other: whitened coordinates at the centre of the tile, and colours.

    Coordinates are scaled by sqrt(1/2): log w is minus their sum of squares. All that does not depend on the size of
    the image is computed for all groups at once, since the time to load grows with the number of operators.
    `visible` is a factor on each region's Gaussians, (R,); `half` stores Cholesky factors and colours in 16 bits.
    """

    def __init__(self, graph: Graph, layout: Layout, visible: Value | None, half: bool) -> None:
        self.g, self.layout = graph, layout
        self.gaussians, groups = layout.gaussians, layout.groups
        self.channels = self.gaussians.colors.shape[1]
        if not groups:
            return
        g = graph
        self._starts = np.cumsum([0, *(group.entries.size for group in groups)])
        steps = zip(self._starts, self._starts[1:], [group.entries.shape[1] for group in groups], strict=False)
        self._begins = np.concatenate([np.arange(*step) for step in steps])  # of each tile's entries
        tile = self._tile_of_entries()
        entries = self._entries(tile)
        with np.errstate(over="ignore"):  # what is too large for 16 bits shows in the image
            stored = [a.astype(np.float16 if half else F32) for a in (self.gaussians.cholesky, self.gaussians.colors)]
        cholesky, colors = (g("Cast", a, to=FLOAT) if half else a for a in [g.constant(a) for a in stored])
        if visible is not None:
            shown = g("Gather", visible, g.whole(self.gaussians.region))
            colors = g("Mul", colors, g("Unsqueeze", shown, g.constant([1])))
        self._whitened = self._whiten(entries, tile, cholesky)
        self._colors = g("Mul", g("Gather", colors, entries), self._real(tile))

    def whitened(self, number: int) -> Value:
        """Coordinates of a group, (T, L, 8): z1 = k0 + k1 x, z2 = k2 + k3 x + k4 y, coefficients of xx, xy, yy."""
        return self._group(self._whitened, number, 8)

    def colors(self, number: int) -> Value:
        """Colours of a group, (T, K * C, L), zero where a Gaussian is of another region."""
        g, group = self.g, self.layout.groups[number]
        colors = g("Transpose", self._group(self._colors, number, self.channels), perm=[0, 2, 1])  # [T, C, L]
        if group.regions == 1:
            return colors
        local = [
            np.searchsorted(self.layout.tiles.regions[tile], self.gaussians.region[entries])
            for tile, entries in zip(group.tiles.tolist(), group.entries, strict=True)
        ]
        same = np.stack(local)[:, None] == np.arange(group.regions)[:, None]  # [T, K, L]
        colors = g("Mul", g("Unsqueeze", colors, g.constant([1])), g("Cast", g.constant(same[:, :, None]), to=FLOAT))
        return g("Reshape", colors, g.constant([0, group.regions * self.channels, -1]))

    def _group(self, values: Value, number: int, width: int) -> Value:
        g = self.g
        start, end = (g.constant([int(bound)]) for bound in self._starts[number : number + 2])
        part = g("Slice", values, start, end, g.constant([0]))
        return g("Reshape", part, g.constant([*self.layout.groups[number].entries.shape, width]))

    def _tile_of_entries(self) -> Value:
        """Place of each entry's tile among the tiles of all groups, (P,)."""
        g = self.g
        parts, first = [], 0
        for group in self.layout.groups:
            count, length = group.entries.shape
            places = g("Range", np.int32(first), np.int32(first + count), np.int32(1))
            places = g("Expand", g("Unsqueeze", places, g.constant([1])), g.constant([count, length]))
            parts.append(g("Reshape", places, g.constant([-1])))
            first += count
        return g("Concat", *parts, axis=0)

    def _entries(self, tile: Value) -> Value:
        """Which Gaussian each entry is, (P,), stored by how much it is more than the one before: mostly in a byte."""
        g = self.g
        steps = [np.diff(group.entries, axis=1, prepend=group.entries[:, :1]) for group in self.layout.groups]
        flat = np.concatenate([part.ravel() for part in steps])
        base = np.concatenate([group.entries[:, 0] for group in self.layout.groups]) - np.cumsum(flat)[self._begins]
        total = g("CumSum", g.whole(flat), np.int64(0))
        return g("Add", total, g("Gather", g.constant(base.astype(np.int32)), tile))

    def _real(self, tile: Value) -> Value:
        """1 for entries, 0 for what lists are filled up with, (P, 1)."""
        g = self.g
        ends = self._begins + np.concatenate([group.lengths for group in self.layout.groups])
        places = g("Range", np.int32(0), np.int32(self._starts[-1]), np.int32(1))
        real = g("Cast", g("Less", places, g("Gather", g.constant(ends.astype(np.int32)), tile)), to=FLOAT)
        return g("Unsqueeze", real, g.constant([1]))

    def _whiten(self, entries: Value, tile: Value, cholesky: Value) -> Value:
        g, cols = self.g, self.layout.tiles.cols
        numbers = np.concatenate([group.tiles for group in self.layout.groups])
        place = g("Cast", g.whole(np.stack([numbers % cols, numbers // cols], -1)), to=FLOAT)
        centre = g("Mul", g("Add", place, F32(0.5)), F32(TILE))
        offset = g("Sub", g("Gather", centre, tile), g("Gather", g.constant(self.gaussians.means), entries))
        x, y = g.apply("Split", [offset], 2, axis=1, num_outputs=2)
        l11, l21, l22 = g.apply("Split", [g("Gather", cholesky, entries)], 3, axis=1, num_outputs=3)
        slope = g("Div", l21, l11)
        e1, k1, k4 = g("Div", x, l11), g("Reciprocal", l11), g("Reciprocal", l22)
        e2 = g("Div", g("Sub", y, g("Mul", slope, x)), l22)
        k3 = g("Neg", g("Div", slope, l22))
        z = g("Mul", g("Concat", e1, k1, e2, k3, k4, axis=1), F32(_ROOT))
        z = g("Clip", z, F32(-Z_LIMIT), F32(Z_LIMIT))
        _, k1, _, k3, k4 = g.apply("Split", [z], 5, axis=1, num_outputs=5)
        xx = g("Neg", g("Add", g("Mul", k1, k1), g("Mul", k3, k3)))
        xy, yy = g("Mul", F32(-2), g("Mul", k3, k4)), g("Neg", g("Mul", k4, k4))
        return g("Concat", z, xx, xy, yy, axis=1)
