"""One image's decoder: its Gaussians, its lists of them and its contours baked into a graph.

The picture is cut into tiles of the scene, each tile into blocks of about 16 x 16 pixels of the output, whatever its
size. In a block log w is a polynomial in the pixel, so that the weights of a list of Gaussians are one matrix product
with the monomials, and its colours another with the weights. Lists of similar length are drawn together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs.functional import RegionMap
from kcgs.kernels.form import Z_LIMIT
from kcgs.nn import GaussianField

from .axis import FLOAT, INT32, Axis
from .graph import Graph, Value, smallest
from .lists import TILE, Entries, Tiles
from .shares import Windows

# what a group of lists costs beside its entries, in entries
_GROUP_COST = 400
# rounding of a polynomial shows in log w where a Gaussian is narrow: pixels, where weights down to a hundred-thousandth
# are wanted, and below that
_NARROW, _NARROW_OF_FAINT = 0.15, 0.4
_FAINT = 1e-5
# |z| is cut here, as in the kernels
F32 = np.float32

Floats = NDArray[np.float32]


class Baked(NamedTuple):
    """What the graph stores of a scene."""

    means: Floats  # [N, 2]
    cholesky: Floats  # [N, 3]
    colors: Floats  # [N, C], opacities merged
    region: NDArray[np.int64]  # [N], position in the map


class Group(NamedTuple):
    """Tiles that are drawn together: lists of similar length, filled up with their last to the longest."""

    tiles: NDArray[np.int64]  # [T]
    entries: NDArray[np.int64]  # [T, L] into the Gaussians, ascending
    lengths: NDArray[np.int64]  # [T]
    regions: int  # in a tile, K; 1: no memberships
    narrow: bool  # whether to sum squares in place of a polynomial


def bake(field: GaussianField, regions: RegionMap | None, entries: Entries) -> tuple[Baked, Entries]:
    """Take the numbers of the Gaussians that are drawn, and number the entries by them."""
    used = entries.gaussian.unique()
    # neighbours get neighbouring numbers, so that lists are stored as small steps
    column, row = (field.means.detach().cpu()[used] / TILE).floor().double().unbind(-1)
    used = used[torch.argsort(row * (1 + 2 * column.abs().amax()) + column, stable=True)] if len(used) else used
    number = torch.full((len(field),), -1)
    number[used] = torch.arange(len(used))
    gaussian = number[entries.gaussian]
    order = torch.argsort(entries.tile * len(field) + gaussian)
    entries = Entries(gaussian[order], entries.tile[order])
    means, cholesky, colors = (
        t.detach().float().cpu()[used].numpy() for t in (field.means, field.cholesky, field.merged_colors())
    )
    region = np.zeros(len(means), np.int64)
    if regions is not None and field.region_ids is not None:
        region = regions.index_of(field.region_ids).cpu()[used].numpy()
    return Baked(means, cholesky, colors, region), entries


def group_tiles(entries: Entries, tiles: Tiles, baked: Baked, cutoff: float) -> list[Group]:
    """Sort tiles into groups so that little is filled up and there are few groups."""
    held, counts = torch.unique_consecutive(entries.tile, return_counts=True)
    starts = (counts.cumsum(0) - counts).tolist()
    narrow = _is_narrow(baked.cholesky, _NARROW if cutoff >= _FAINT else _NARROW_OF_FAINT)
    kinds: dict[tuple[int, bool], list[tuple[int, NDArray[np.int64]]]] = {}
    for tile, start, count in zip(held.tolist(), starts, counts.tolist(), strict=True):
        own = entries.gaussian[start : start + count].numpy()
        regions = len(tiles.regions[tile]) if tile in tiles.windows else 1
        # few kinds: counts of regions rise by powers of two
        kind = (1 << (regions - 1).bit_length(), bool(narrow[own].any()))
        kinds.setdefault(kind, []).append((tile, own))
    return [_make_group(some, *kind) for kind, lists in sorted(kinds.items()) for some in _split_by_length(lists)]


def _is_narrow(cholesky: Floats, width: float) -> NDArray[np.bool_]:
    l11, l21, l22 = cholesky.astype(np.float64).T
    steepest: NDArray[np.float64] = np.hypot(np.hypot(1 / l11, l21 / (l11 * l22)), 1 / l22)
    return steepest * width > 1


def _split_by_length(lists: list[tuple[int, NDArray[np.int64]]]) -> list[list[tuple[int, NDArray[np.int64]]]]:
    """Cut the lists, sorted by length, where that costs least: the best cuts by dynamic programming."""
    lists = sorted(lists, key=lambda item: len(item[1]))
    lengths, first = np.unique([len(own) for _, own in lists], return_index=True)
    ends = [*first[1:].tolist(), len(lists)]
    best, cut = [0.0], [0]
    for j, end in enumerate(ends):
        costs = [best[i] + (end - first[i]) * lengths[j] + _GROUP_COST for i in range(j + 1)]
        best.append(min(costs))
        cut.append(int(np.argmin(costs)))
    parts, j = [], len(ends)
    while j > 0:
        i = cut[j]
        parts.append(lists[first[i] : ends[j - 1]])
        j = i
    return parts[::-1]


def _make_group(some: list[tuple[int, NDArray[np.int64]]], regions: int, narrow: bool) -> Group:
    longest = max(len(own) for _, own in some)
    entries = np.stack([np.pad(own, (0, longest - len(own)), mode="edge") for _, own in some])
    tiles, lengths = np.array([[tile, len(own)] for tile, own in some]).T
    return Group(tiles, entries, lengths, regions, narrow)


class Drawing:
    """Draws groups of tiles; what they have in common is made once."""

    def __init__(
        self, graph: Graph, baked: Baked, down: Axis, across: Axis, cutoff: float, visible: Value | None, half: bool
    ) -> None:
        """Take what all groups share.

        Args:
            graph: the graph.
            baked: the Gaussians.
            down: rows.
            across: columns.
            cutoff: of weights.
            visible: factor on each region's Gaussians, (R,), or None.
            half: whether to store factors and colours in 16 bits.
        """
        self.g, self.baked, self.down, self.across = graph, baked, down, across
        self.cutoff = cutoff
        g = graph
        self.channels = baked.colors.shape[1]
        self.means = g.constant(baked.means)
        if half:
            with np.errstate(over="ignore"):  # what is too large shows in the picture
                stored = [g.constant(a.astype(np.float16)) for a in (baked.cholesky, baked.colors)]
            self.cholesky, self.colors = (g("Cast", a, to=FLOAT) for a in stored)
        else:
            self.cholesky, self.colors = g.constant(baked.cholesky), g.constant(baked.colors)
        if visible is not None:
            shown = g("Gather", visible, g.constant(baked.region))
            self.colors = g("Mul", self.colors, g("Unsqueeze", shown, g.constant([1])))
        # a block's pixels go column by column, as the picture is put together
        self.pixels = g("Mul", across.side, down.side)  # P
        y, x = g("Unsqueeze", down.steps, g.constant([0])), g("Unsqueeze", across.steps, g.constant([1]))
        sides = g("Concat", across.side, down.side, axis=0)
        x, y = g("Expand", x, sides), g("Expand", y, sides)
        flat = g.constant([-1])
        x, y = g("Reshape", x, flat), g("Reshape", y, flat)
        one = g("Add", g("Mul", x, F32(0)), F32(1))
        rows = (one, x, y, g("Mul", x, x), g("Mul", x, y), g("Mul", y, y))
        self.monomials = g("Concat", *[g("Unsqueeze", r, g.constant([0])) for r in rows], axis=0)  # [6, P]

    def group(self, group: Group, tiles: Tiles, blocks: Value, slots: Value, windows: Windows | None) -> Value:
        """Draw the blocks of a group.

        Args:
            group: which tiles.
            tiles: of the scene.
            blocks: (B,), by number: row times columns plus column.
            slots: (B,), the tile of each, by place in the group.
            windows: memberships, where any tile has several regions.

        Returns:
            (B, C, P).
        """
        g = self.g
        form, colors = self._constants(group, tiles)
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

    def _constants(self, group: Group, tiles: Tiles) -> tuple[Value, Value]:
        """Whitened coordinates at the tiles' centres (T, L, 8), and colours (T, K * C, L): folded when loaded."""
        g = self.g
        # a byte each: by how much an entry is more than the one before
        steps = g("Cast", g.constant(smallest(np.diff(group.entries, axis=1, prepend=group.entries[:, :1]))), to=INT32)
        first = g("Cast", g.constant(smallest(group.entries[:, :1])), to=INT32)
        entries = g("Add", first, g("CumSum", steps, np.int64(1)))
        place = np.stack([group.tiles % tiles.cols, group.tiles // tiles.cols], -1)[:, None, :]
        centre = g("Mul", g("Add", g("Cast", g.constant(smallest(place)), to=FLOAT), F32(0.5)), F32(TILE))
        offset = g("Sub", centre, g("Gather", self.means, entries))
        x, y = g.apply("Split", [offset], 2, axis=2, num_outputs=2)
        l11, l21, l22 = g.apply("Split", [g("Gather", self.cholesky, entries)], 3, axis=2, num_outputs=3)
        slope = g("Div", l21, l11)
        e1, k1, k4 = g("Div", x, l11), g("Reciprocal", l11), g("Reciprocal", l22)
        e2 = g("Div", g("Sub", y, g("Mul", slope, x)), l22)
        k3 = g("Neg", g("Div", slope, l22))
        half = F32(-0.5)
        shape = (
            g("Mul", half, g("Add", g("Mul", k1, k1), g("Mul", k3, k3))),
            g("Neg", g("Mul", k3, k4)),
            g("Mul", half, g("Mul", k4, k4)),
        )
        form = g("Concat", e1, k1, e2, k3, k4, *shape, axis=2)
        if group.narrow:
            form = g("Clip", form, F32(-Z_LIMIT), F32(Z_LIMIT))
        colors = g("Transpose", g("Gather", self.colors, entries), perm=[0, 2, 1])  # [T, C, L]
        real = np.arange(group.entries.shape[1]) < group.lengths[:, None]
        if group.regions == 1:
            return form, colors if real.all() else g("Mul", colors, g("Cast", g.constant(real[:, None]), to=FLOAT))
        local = [
            np.searchsorted(tiles.regions[tile], self.baked.region[own])
            for tile, own in zip(group.tiles.tolist(), group.entries, strict=True)
        ]
        own = real[:, None] & (np.stack(local)[:, None] == np.arange(group.regions)[:, None])  # [T, K, L]
        colors = g("Mul", g("Unsqueeze", colors, g.constant([1])), g("Cast", g.constant(own[:, :, None]), to=FLOAT))
        colors = g("Reshape", colors, g.constant([0, group.regions * self.channels, -1]))
        return form, colors

    def _polynomial(self, z1: Value, k1: Value, z2: Value, k3: Value, k4: Value, shape: Value) -> Value:
        g = self.g
        constant = g("Mul", F32(-0.5), g("Add", g("Mul", z1, z1), g("Mul", z2, z2)))
        along = g("Neg", g("Add", g("Mul", z1, k1), g("Mul", z2, k3)))
        down = g("Neg", g("Mul", z2, k4))
        return g("MatMul", g("Concat", constant, along, down, shape, axis=2), self.monomials)

    def _squares(self, z1: Value, k1: Value, z2: Value, k3: Value, k4: Value) -> Value:
        g = self.g
        one, x, y = (
            g("Slice", self.monomials, g.constant([i]), g.constant([i + 1]), g.constant([0])) for i in range(3)
        )
        first = g("Add", z1, g("Mul", k1, x))  # [B, L, P]
        second = g("MatMul", g("Concat", z2, k3, k4, axis=2), g("Concat", one, x, y, axis=0))
        total = g("Add", g("Mul", first, first), g("Mul", second, second))
        return g("Mul", F32(-0.5), total)
