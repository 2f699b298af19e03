"""The image of a decoder, rendered in blocks: log w is a polynomial in the pixel.

So the weights of a list of Gaussians are one matrix product with the monomials, and its colours another with the
weights. docs/onnx.md has the whole graph.
"""

from __future__ import annotations

import numpy as np

from .axis import Axis
from .entries import Storage
from .graph import INT64, Value
from .grids import CoarseGrids
from .groups import Group, Integers
from .membership import MembershipSampler
from .packing import pack_integers
from .tiles import Tiles
from .weights import monomials, weigh

# what the monomials 1, x, y, xx, xy, yy at (x + a, y + b) have besides those at (x, y): place of the factor among a, b,
# aa, ab, bb, the monomial there, the monomial here, and how often
_SHIFT = (
    (0, 1, 0, 1),
    (1, 2, 0, 1),
    (2, 3, 0, 1),
    (3, 4, 0, 1),
    (4, 5, 0, 1),
    (0, 3, 1, 2),
    (1, 4, 1, 1),
    (0, 4, 2, 1),
    (1, 5, 2, 2),
)


class BlockRenderer:
    """Renders blocks, of rows `down` and columns `across`, group by group; what groups have in common is made once."""

    def __init__(self, storage: Storage, down: Axis, across: Axis, cutoff: float) -> None:
        self.graph = storage.graph
        self.storage = storage
        self.down = down
        self.across = across
        self.cutoff = cutoff
        self.pixels = across.side * down.side  # P
        self.monomials = monomials(storage.graph, across.steps, down.steps)  # [6, P]
        self.shifts = self._make_shifts()

    def image(self, membership: MembershipSampler | None, grids: CoarseGrids | None) -> Value:
        """Render the image, (1, C, H, W); memberships are needed where any tile has several regions."""
        g, groups, channels = self.graph, self.storage.plan.pixel_groups, self.storage.channels
        tile = g.Unsqueeze(self.down.tile * self.storage.plan.tiles.cols, [1]) + self.across.tile
        tile = g.Reshape(tile, [-1])
        group_of_block = g.Min(self.storage.slots.group[tile].astype(INT64), len(groups))
        slots = self.storage.slots.slot[tile].astype(INT64)
        order, starts, stops, index = self._sort(group_of_block, len(groups))
        rendered = []
        for number, group in enumerate(groups):
            blocks = g.Slice(order, starts[number], stops[number], [0])
            slot = g.Min(slots[blocks], len(group.tiles) - 1)
            rendered.append(self._render_group(number, blocks, slot, membership, grids))
        # one black block for all that nothing reaches
        rendered.append(g.Expand(np.float32(0), g.Concat([1, channels], self.pixels, axis=0)))
        return self._join(g.Concat(*rendered, axis=0), index, grids)

    def _make_shifts(self) -> Value:
        """Make what turns coefficients around a tile's centre into those around each block's middle, (NB, 6, 6)."""
        g = self.graph
        sides = g.Concat(self.down.blocks, self.across.blocks, [1], axis=0)
        x = g.Expand(g.Reshape(self.across.origins, [1, -1, 1]), sides)
        y = g.Expand(g.Reshape(self.down.origins, [-1, 1, 1]), sides)
        powers = g.Reshape(g.Concat(x, y, x * x, x * y, y * y, axis=2), [-1, 5])
        basis = np.zeros((5, 6, 6), np.float32)
        for factor, there, here, count in _SHIFT:
            basis[factor, there, here] = count
        return g.Reshape(powers @ basis.reshape(5, 36), [-1, 6, 6]) + np.eye(6, dtype=np.float32)

    def _sort(self, group: Value, count: int) -> tuple[Value, list[Value], list[Value], Value]:
        """Sort blocks by group, (NB,); return them, one to spare, groups' begins, their ends, where each is rendered.

        A group without a block renders one that the image leaves out: not every runtime takes tensors without elements.
        """
        g = self.graph
        total = g.Shape(group)
        order = g.argsort(group * total + g.Range(0, g.Squeeze(total), 1), total)
        rank = g.argsort(order, total)
        members = g.Equal(g.constant(np.arange(count + 1)[:, None]), group).astype(INT64)
        counts = g.ReduceSum(members, [1], keepdims=0)
        sizes = g.Max(counts, [1] * count + [0])
        starts, firsts = (g.CumSum(n, 0, exclusive=1) for n in (counts, sizes))
        index = g.Min(rank + (firsts - starts)[group], firsts[g.constant([count])])
        order = g.Concat(order, [0], axis=0)
        begins, ends = (g.split(bound, [1] * (count + 1)) for bound in (starts, starts + sizes))
        return order, begins, ends, index

    def _render_group(
        self, number: int, blocks: Value, slots: Value, membership: MembershipSampler | None, grids: CoarseGrids | None
    ) -> Value:
        """Render blocks (B,) of a group, (B, C, P); `slots`, (B,), are their tiles by place in the group."""
        g, entries = self.graph, self.storage.entries[number]
        group, regions = entries.group, None
        if group.regions > 1:
            regions = pack_integers(g, _regions_of_tiles(self.storage.plan.tiles, group))
        colors = entries.shaped_colors(regions)
        coefficients = entries.shaped_coefficients()[slots]  # [B, L, 6]
        exponent = (self._squares if group.narrow else self._polynomial)(coefficients, blocks)
        values = colors[slots] @ weigh(g, exponent, self.cutoff)  # [B, K * C, P]
        if membership is None or regions is None:
            return values
        row, col = blocks // self.across.blocks, blocks % self.across.blocks
        if grids is not None:
            values = values + grids.blocks(entries, regions, slots, row, col)
        values = g.Reshape(values, [0, group.regions, self.storage.channels, -1])
        return g.ReduceSum(values * membership.blocks(number, slots, row, col), [1], keepdims=0)

    def _polynomial(self, coefficients: Value, blocks: Value) -> Value:
        """Log w as coefficients times monomials."""
        return coefficients @ self.shifts[blocks] @ self.monomials

    def _squares(self, coefficients: Value, blocks: Value) -> Value:
        """Log w as a sum of squares, which no rounding of large coefficients harms."""
        g, three = self.graph, self.graph.constant([3])
        shift = g.Slice(self.shifts[blocks], [0, 0], [3, 3], [1, 2])
        linear = g.Slice(self.monomials, [0], three, [0])
        z1, z2 = (part @ shift @ linear for part in g.split(coefficients, [3, 3], axis=2))
        return -(z1 * z1 + z2 * z2)

    def _join(self, blocks: Value, index: Value, grids: CoarseGrids | None) -> Value:
        """Join the blocks (n, C, P), and add the coarse grids; then leave out the pixels to spare."""
        g, down, across, channels = self.graph, self.down, self.across, self.storage.channels
        # stretches of memory: of a block's channel and column, all its rows
        stretches = g.Reshape(blocks, g.Concat([-1], down.side, axis=0))
        area = across.side * np.array([channels])
        first = g.Reshape(index, g.Concat(down.blocks, across.blocks, axis=0)) * area
        first = g.Gather(first, across.place // across.side, axis=1) + across.place % across.side
        channel = np.arange(channels)[:, None]
        stretch = g.Unsqueeze(first, [1]) + g.constant(channel) * across.side
        image = stretches[stretch]  # [blocks, C, width, side]: blocks are read one row of them at a time
        image = g.Transpose(image, perm=[0, 1, 3, 2])
        if grids is not None:
            image = image + grids.image()
        image = g.Reshape(image, g.Concat([-1], across.size, axis=0))
        place = down.place // down.side * channels + channel
        place = place * down.side + down.place % down.side
        return image[g.Unsqueeze(place, [0])]


def _regions_of_tiles(tiles: Tiles, group: Group) -> Integers:
    """Regions of a group's tiles, (T, K), filled up with one that no Gaussian has."""
    lists = [tiles.regions[tile] for tile in group.tiles.tolist()]
    no_region = 1 + max(max(regions) for regions in tiles.regions)
    return np.array([regions + [no_region] * (group.regions - len(regions)) for regions in lists])
