"""The image of a decoder, rendered in blocks of pixels.

The logarithm of a weight, log w, is a polynomial in the pixel's position. One matrix product of coefficients and
monomials gives the weights of a list of Gaussians, a second one gives the colours. docs/onnx.md has the whole graph.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np

from .axis import Axis
from .entries import Storage
from .graph import INT64, Value
from .grids import CoarseGrids
from .groups import Integers
from .membership import MembershipSampler
from .packing import pack_integers
from .tiles import Tiles
from .weights import monomials, weigh

# The monomials 1, x, y, xx, xy, yy at (x + a, y + b) are the monomials at (x, y) plus these terms: (factor, source,
# target, multiplicity). A factor is the index of 1, a, b, aa, ab, bb; the source is a monomial at (x + a, y + b).
_SHIFT = (
    *((k, k, 0, 1) for k in range(1, 6)),
    (1, 3, 1, 2),
    (2, 4, 1, 1),
    (1, 4, 2, 1),
    (2, 5, 2, 2),
)


class BlockRenderer:
    """Render blocks group by group; `down` has their rows, `across` their columns; all groups share the monomials."""

    def __init__(self, storage: Storage, down: Axis, across: Axis, cutoff: float) -> None:
        self.graph = storage.graph
        self.storage = storage
        self.down = down
        self.across = across
        self.cutoff = cutoff
        self.pixels = across.side * down.side  # P
        self.pieces = across.pieces * down.pieces  # blocks of a tile, Q
        self.monomials = monomials(storage.graph, storage.graph.Unsqueeze(across.steps, [1]), down.steps)  # [6, P]
        self.shifts = self._make_shifts()
        self.is_native = storage.graph.And(down.is_native, across.is_native)

    def image(self, membership: MembershipSampler | None, grids: CoarseGrids | None) -> Value:
        """Render the image, (1, C, H, W) with spare pixels; tiles with several regions need memberships.

        Without a view the operators that sort tiles read only constants, so that runtimes compute them on loading.
        """
        g, groups = self.graph, self.storage.plan.pixel_groups
        tile = g.Unsqueeze(self.down.tile * self.storage.plan.tiles.cols, [1]) + self.across.tile
        tile = g.Reshape(tile, [-1])
        group_of_tile = g.Min(self.storage.slots.group[tile].astype(INT64), len(groups))
        slots = self.storage.slots.slot[tile].astype(INT64)
        order, starts, stops, index = self._sort(group_of_tile, len(groups))
        members = []  # tiles of each group, and their places in it
        for number, group in enumerate(groups):
            tiles = g.Slice(order, starts[number], stops[number], [0])
            members.append((tiles, g.Min(slots[tiles], len(group.tiles) - 1)))
        rendered = []
        for count, numbers in groupby(range(len(groups)), lambda number: groups[number].regions):
            if count == 1 or membership is None:
                rendered += [self._render_group(number, *members[number]) for number in numbers]
            else:
                rendered.append(self._render_mixed(count, [*numbers], members, membership, grids))
        # one black tile, for all tiles that no Gaussian reaches
        shape = g.Concat([1], self.pieces, [self.storage.channels], self.pixels, axis=0)
        rendered.append(g.Expand(np.float32(0), shape))
        image = self._join(g.Concat(*rendered, axis=0), index)
        if grids is not None:
            image = image + self._shape(grids.image())
        return image

    def _make_shifts(self) -> Value:
        """Return matrices (V, Q, 6, 6) that move coefficients from the centre of a tile to the middles of blocks."""
        g = self.graph
        x, y = g.Unsqueeze(self.across.origins, [0, 2]), g.Unsqueeze(self.down.origins, [1, 3])
        basis = np.zeros((6, 6, 6), np.float32)
        basis[0] = np.eye(6)
        for factor, there, here, count in _SHIFT:
            basis[factor, there, here] = count
        shifts = g.Transpose(monomials(g, x, y), perm=[1, 0]) @ basis.reshape(6, 36)
        return g.Reshape(shifts, g.Concat([-1], self.pieces, [6, 6], axis=0))

    def _sort(self, group: Value, count: int) -> tuple[Value, list[Value], list[Value], Value]:
        """Sort tiles by group, (V,); return the order, begins and ends of groups in it, and the place of each tile.

        A group without a tile renders a tile of another group, which the image does not use: some runtimes do not
        accept empty tensors. So that this holds for the last group, the order has one more element.
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

    def _render_group(self, number: int, tiles: Value, slots: Value, regions: Value | None = None) -> Value:
        """Render a group in its tiles (T,): (T, Q, C, P), or separately for each of their regions, (T, Q, K * C, P)."""
        g, entries = self.graph, self.storage.entries[number]
        colors = g.Unsqueeze(entries.shaped_colors(regions)[slots], [1])
        coefficients = g.Unsqueeze(entries.shaped_coefficients()[slots], [1])  # [T, 1, L, 6]
        exponent = (self._squares if entries.group.narrow else self._polynomial)(coefficients, tiles)
        return colors @ weigh(g, exponent, self.cutoff)

    def _render_mixed(
        self,
        count: int,
        numbers: list[int],
        members: list[tuple[Value, Value]],
        membership: MembershipSampler,
        grids: CoarseGrids | None,
    ) -> Value:
        """Render the groups of tiles with K regions, (T, Q, C, P)."""
        g, plan = self.graph, self.storage.plan
        lengths = [len(plan.groups[number].tiles) for number in numbers]
        regions = pack_integers(g, _regions_of_tiles(plan.tiles, plan.mixed_tiles[count], count))
        parts = zip(numbers, g.split(regions, lengths), strict=True)
        values = g.Concat(*(self._render_group(number, *members[number], part) for number, part in parts), axis=0)
        values = g.Reshape(values, [0, 0, count, self.storage.channels, -1])
        tiles = g.Concat(*(members[number][0] for number in numbers), axis=0)
        firsts = np.cumsum([0, *lengths[:-1]]).tolist()
        slots = g.Concat(*(members[number][1] + first for number, first in zip(numbers, firsts, strict=True)), axis=0)
        columns = g.Shape(self.across.tile)
        row, col = tiles // columns, tiles % columns
        if grids is not None:
            values = values + grids.blocks(count, regions, slots, row, col)
        return g.ReduceSum(values * membership.blocks(count, slots, row, col), [2], keepdims=0)

    def _polynomial(self, coefficients: Value, tiles: Value) -> Value:
        """Return log w as coefficients times monomials."""
        g = self.graph
        centred = g.choose(self.is_native, lambda: g.Identity(coefficients), lambda: coefficients @ self.shifts[tiles])
        return centred @ self.monomials

    def _squares(self, coefficients: Value, tiles: Value) -> Value:
        """Return log w as a negative sum of squares, which the rounding of large coefficients does not harm."""
        g, three = self.graph, self.graph.constant([3])
        shifts = g.Slice(self.shifts[tiles], [0, 0], [3, 3], [2, 3])
        linear = g.Slice(self.monomials, [0], three, [0])
        z1, z2 = (part @ shifts @ linear for part in g.split(coefficients, [3, 3], axis=3))
        return -(z1 * z1 + z2 * z2)

    def _join(self, blocks: Value, index: Value) -> Value:
        """Join the blocks of all tiles, (n, Q, C, P), to an image with spare pixels; tile k is at `index[k]`."""
        g, down, across, channels = self.graph, self.down, self.across, self.storage.channels
        first = g.Reshape(index * self.pieces, g.Concat([-1, 1], g.Shape(across.tile), [1], axis=0))
        piece = g.Reshape(g.Range(0, g.Squeeze(self.pieces), 1), g.Concat(down.pieces, [1], across.pieces, axis=0))
        place = (first + piece) * channels  # [tile row, piece, tile column, piece]
        place = place + g.constant(np.arange(channels).reshape(-1, 1, 1, 1, 1))
        blocks = g.Reshape(blocks, g.Concat([-1], self.pixels, axis=0))[place]
        columns = g.Reshape(blocks, g.Concat([channels, -1], across.padded, down.side, axis=0))
        return self._shape(g.Transpose(columns, perm=[0, 1, 3, 2]))

    def _shape(self, image: Value) -> Value:
        return self.graph.Reshape(image, self.graph.Concat([1, self.storage.channels, -1], self.across.padded, axis=0))


def _regions_of_tiles(tiles: Tiles, ids: Integers, count: int) -> Integers:
    """Return the regions of tiles, (T, K), padded with a region that no Gaussian has."""
    lists = [tiles.regions[tile] for tile in ids.tolist()]
    no_region = 1 + max(max(regions) for regions in tiles.regions)
    return np.array([regions + [no_region] * (count - len(regions)) for regions in lists])
