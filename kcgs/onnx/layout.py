"""What a decoder stores of a scene: its Gaussians, and its tiles in groups whose lists are of similar length."""

from __future__ import annotations

from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.kernels.octaves import Blocks, Coarsened, make_blocks
from kcgs.kernels.tiles import TILE
from kcgs.nn import GaussianField

from .lists import list_gaussians, place

# what a group of lists costs beside its entries, in entries; one of nodes is evaluated only when a decoder is loaded
_GROUP_COST, _NODES_COST = 450, 4000
# what coarse grids cost, in entries: whatever they hold, and for each tile and region
_GRIDS_COST, _SPLINE_COST = 2000, 7
# rounding of a polynomial shows in log w where a Gaussian is narrow: pixels, where weights down to a hundred-thousandth
# are wanted, and below that
_NARROW, _NARROW_OF_FAINT = 0.15, 0.4
_FAINT = 1e-5

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]


class Tiles(NamedTuple):
    """The tiles of a scene in raster order, and the windows that region weights are sampled from.

    A window is a tile and `margin` pixels around it, those of the border repeated beyond it; of hard contours it is of
    labels, which may be finer than pixels.
    """

    rows: int
    cols: int
    regions: list[list[int]]  # of each tile, positions in the map: those with any weight in its window
    windows: dict[int, Tensor]  # of each tile with several regions: [K, side, side] weights (soft), or [side, side]
    # positions in the tile's list of regions (hard)


class Gaussians(NamedTuple):
    """The Gaussians that touch a pixel; those of coarser grids as these see them."""

    means: Floats  # [N, 2]
    cholesky: Floats  # [N, 3]
    colors: Floats  # [N, C], opacities merged
    region: Integers  # [N], position in the map


class Nodes(NamedTuple):
    """The blocks of coarser grids where anything is, and the table of all that there may be."""

    place: Integers  # [n, 4] level - 1, region, row and column, ascending
    shape: tuple[int, int, int, int]  # one level more than there are, one region more: nothing is there


class Group(NamedTuple):
    """Tiles that are rendered together: lists of similar length, filled up with their last to the longest."""

    tiles: Integers  # [T], or blocks of nodes, which are numbered behind the tiles
    lengths: Integers  # [T]
    regions: int  # of a tile, K; 1: no region weights
    narrow: bool  # whether to sum squares in place of a polynomial
    nodes: bool  # whether these are blocks of nodes

    @property
    def longest(self) -> int:
        """What all lists are filled up to, L."""
        return max(1, int(self.lengths.max()))


class Layout(NamedTuple):
    """All that a decoder stores."""

    tiles: Tiles
    gaussians: Gaussians
    groups: list[Group]  # those of nodes last
    pairs: Integers  # [2, P] Gaussian and tile of every entry, in this order
    nodes: Nodes | None  # None: no coarser grids


def lay_out(field: GaussianField, regions: RegionMap | None, cutoff: float) -> Layout:
    """Find what is rendered where, and group it."""
    tiles = find_tiles(regions, field.size)
    count = 1 if regions is None else regions.num_regions
    region = torch.zeros(field.num_gaussians, dtype=torch.int64)
    if regions is not None and field.region_ids is not None:
        region = regions.index_of(field.region_ids).cpu()
    keys = [number * count + r for number, found in enumerate(tiles.regions) for r in found]
    blocks = make_blocks(torch.tensor(keys), count, (1, *field.size))
    placed, gaussian, block = _find_pairs(field, region, count, blocks, cutoff)
    nodes, number = _number_blocks(blocks, count, tiles, block)
    tile = number[block]
    used = gaussian.unique()
    # neighbours get neighbouring numbers, so that lists are stored as small steps
    column, row = (placed.means[used] / TILE).floor().unbind(-1)
    rank = torch.argsort(row * (1 + 2 * column.abs().amax()) + column, stable=True) if len(used) else used
    used = used[rank[torch.argsort(placed.level[used][rank], stable=True)]]
    entry = torch.full((field.num_gaussians,), -1)
    entry[used] = torch.arange(len(used))
    entry = entry[gaussian]
    merged = field.merged_colors().detach().double().cpu() * placed.factor[:, None]
    means, cholesky, colors = (t[used].float().numpy() for t in (placed.means, placed.cholesky, merged))
    gaussians = Gaussians(means, cholesky, colors, region[used].numpy())
    narrow = _is_narrow(gaussians.cholesky, _NARROW if cutoff >= _FAINT else _NARROW_OF_FAINT)
    pairs = torch.stack([entry, tile])[:, torch.argsort(entry * len(number) + tile)].numpy()
    return Layout(tiles, gaussians, _group_tiles(pairs, tiles, narrow, nodes), pairs, nodes)


def _find_pairs(
    field: GaussianField, region: Tensor, count: int, blocks: Blocks, cutoff: float
) -> tuple[Coarsened, Tensor, Tensor]:
    """Pair Gaussians with blocks of pixels, or, if that saves enough of them, wide ones with blocks of nodes."""
    means, cholesky = (t.detach().double().cpu() for t in (field.means, field.cholesky))
    placed = place(means, cholesky, cutoff, 1)
    gaussian, block = list_gaussians(placed, region, count, blocks, cutoff)
    coarse = place(means, cholesky, cutoff, len(blocks.grids))
    saved = int((coarse.level[gaussian] > 0).sum())
    if saved <= _GRIDS_COST + _SPLINE_COST * blocks.first:
        return placed, gaussian, block
    return coarse, *list_gaussians(coarse, region, count, blocks, cutoff)


def _number_blocks(blocks: Blocks, count: int, tiles: Tiles, touched: Tensor) -> tuple[Nodes | None, Tensor]:
    """Return the blocks of nodes where anything is, and the numbers of all blocks."""
    number = blocks.keys // count
    live = torch.zeros(len(number) + 1, dtype=torch.bool)
    live[touched] = True
    if not live[blocks.first :].any():
        return None, number
    for first, end in reversed(list(pairwise(blocks.starts[1:]))):
        live[first:end] |= live[blocks.parents[first:end]].any(1)
    chosen = live[blocks.first : -1].nonzero()[:, 0] + blocks.first
    level = torch.searchsorted(torch.tensor(blocks.starts[1:]), chosen, right=True) - 1
    cols, first_tile = torch.tensor([[grid.cols, grid.first_tile] for grid in blocks.grids[1:]])[level].T
    tile = number[chosen] - first_tile
    place = torch.stack([level, blocks.keys[chosen] % count, tile // cols, tile % cols], -1).numpy()
    order = np.lexsort(place.T[::-1])
    number[chosen[order]] = len(tiles.regions) + torch.arange(len(place))
    return Nodes(place[order], (int(level.max()) + 2, count + 1, tiles.rows // 2 + 1, tiles.cols // 2 + 1)), number


def _group_tiles(pairs: Integers, tiles: Tiles, is_narrow: NDArray[np.bool_], nodes: Nodes | None) -> list[Group]:
    """Sort tiles into groups so that little is filled up and there are few groups."""
    total = len(tiles.regions) + (0 if nodes is None else len(nodes.place))
    lengths, narrow_ones = (np.bincount(tile, minlength=total) for tile in (pairs[1], pairs[1, is_narrow[pairs[0]]]))
    kinds: dict[tuple[bool, int, bool], list[tuple[int, int]]] = {}
    for number, length in enumerate(lengths.tolist()):
        regions = len(tiles.regions[number]) if number in tiles.windows else 1
        # a tile with several regions needs a list for what comes from coarser grids, too
        if length or (nodes is not None and regions > 1):
            # few kinds: counts of regions rise by powers of two
            kind = (number >= len(tiles.regions), 1 << (regions - 1).bit_length(), bool(narrow_ones[number]))
            kinds.setdefault(kind, []).append((length, number))
    groups = []
    for (of_nodes, regions, narrow), found in sorted(kinds.items()):
        for part in _split_by_length(sorted(found), _NODES_COST if of_nodes else _GROUP_COST):
            numbers, counts = np.array(sorted((number, length) for length, number in part)).T
            groups.append(Group(numbers, counts, regions, narrow, of_nodes))
    return groups


def _is_narrow(cholesky: Floats, width: float) -> NDArray[np.bool_]:
    l11, l21, l22 = cholesky.astype(np.float64).T
    steepest: NDArray[np.float64] = np.hypot(np.hypot(1 / l11, l21 / (l11 * l22)), 1 / l22)
    return steepest * width > 1


def _split_by_length(lists: list[tuple[int, int]], group_cost: int) -> list[list[tuple[int, int]]]:
    """Cut the lists, sorted by their lengths, where that costs least: the best cuts by dynamic programming."""
    lengths, first = np.unique([length for length, _ in lists], return_index=True)
    ends = [*first[1:].tolist(), len(lists)]
    best, cut = [0.0], [0]
    for j, end in enumerate(ends):
        costs = [best[i] + (end - first[i]) * lengths[j] + group_cost for i in range(j + 1)]
        best.append(min(costs))
        cut.append(int(np.argmin(costs)))
    parts, j = [], len(ends)
    while j > 0:
        i = cut[j]
        parts.append(lists[first[i] : ends[j - 1]])
        j = i
    return parts[::-1]


def find_tiles(regions: RegionMap | None, size: tuple[int, int]) -> Tiles:
    """Find the regions of every tile."""
    rows, cols = -(-size[0] // TILE), -(-size[1] // TILE)
    if regions is None or regions.num_regions == 1:
        return Tiles(rows, cols, [[0]] * (rows * cols), {})
    find = _hard_windows if regions.softness == 0.0 else _soft_windows
    return Tiles(rows, cols, *find(regions, rows, cols))


def _hard_windows(regions: RegionMap, rows: int, cols: int) -> tuple[list[list[int]], dict[int, Tensor]]:
    index = regions.index[0].long().cpu()
    down, across = (
        (torch.arange(n)[:, None] * TILE + torch.arange(-1, TILE + 1)).clamp(0, length - 1)
        for n, length in zip((rows, cols), index.shape, strict=True)
    )
    found: list[list[int]] = []
    windows: dict[int, Tensor] = {}
    for y, x in product(down, across):
        present, window = torch.unique(index[y[:, None], x], return_inverse=True)
        if len(present) > 1:
            windows[len(found)] = window
        found.append(present.tolist())
    return found, windows


def _soft_windows(regions: RegionMap, rows: int, cols: int) -> tuple[list[list[int]], dict[int, Tensor]]:
    membership, count = regions.membership, regions.num_regions
    keys = membership.tiles(TILE).keys.cpu()
    # a window sees the tiles around it
    steps = torch.arange(-1, 2)
    y = (keys // count // cols)[:, None, None] + steps[:, None]
    x = (keys // count % cols)[:, None, None] + steps
    inside = (y >= 0) & (y < rows) & (x >= 0) & (x < cols)
    keys = ((y * cols + x) * count + (keys % count)[:, None, None])[inside].unique()
    tile, region = keys // count, keys % count
    mixed = torch.bincount(tile)[tile] > 1
    weights = _window_weights(regions, tile[mixed] // cols * TILE - 1, tile[mixed] % cols * TILE - 1, region[mixed])
    seen = weights.flatten(1).amax(1) > 0
    kept = ~mixed
    kept[mixed] = seen
    found = region[kept].split(torch.bincount(tile[kept]).tolist())
    numbers, counts = tile[mixed][seen].unique_consecutive(return_counts=True)
    parts = zip(numbers.tolist(), weights[seen].split(counts.tolist()), strict=True)
    return [part.tolist() for part in found], {number: part for number, part in parts if len(part) > 1}


def _window_weights(regions: RegionMap, rows: Tensor, cols: Tensor, region: Tensor) -> Tensor:
    """Evaluate regions over windows that begin at these rows and columns, those of the border repeated beyond it."""
    side, device = TILE + 2, regions.labels.device
    image, r, y, x = (part.to(device) for part in (torch.zeros_like(region), region, rows, cols))
    weights = regions.membership.window_weights(image, r, y, x, (side, side)).cpu()
    down, across = (
        (begin[:, None] + torch.arange(side)).clamp(0, length - 1) - begin[:, None]
        for begin, length in zip((rows, cols), regions.size, strict=True)
    )
    return weights.gather(1, down[:, :, None].expand_as(weights)).gather(2, across[:, None, :].expand_as(weights))
