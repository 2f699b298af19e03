"""What a decoder stores of a scene: its Gaussians, and its tiles in groups whose lists are of similar length."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.kernels.tiles import TILE, bounding_tiles, find_keys
from kcgs.kernels.whitened import support_radius
from kcgs.nn import GaussianField

_CHUNK = 1 << 20
# what a group of lists costs beside its entries, in entries
_GROUP_COST = 450
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
    """The Gaussians that touch a pixel."""

    means: Floats  # [N, 2]
    cholesky: Floats  # [N, 3]
    colors: Floats  # [N, C], opacities merged
    region: Integers  # [N], position in the map


class Group(NamedTuple):
    """Tiles that are rendered together: lists of similar length, filled up with their last to the longest."""

    tiles: Integers  # [T]
    entries: Integers  # [T, L] into the Gaussians, ascending
    lengths: Integers  # [T]
    regions: int  # of a tile, K; 1: no region weights
    narrow: bool  # whether to sum squares in place of a polynomial


class Layout(NamedTuple):
    """All that a decoder stores."""

    tiles: Tiles
    gaussians: Gaussians
    groups: list[Group]
    pairs: Integers  # [2, P] Gaussian and tile of every entry, in this order


def lay_out(field: GaussianField, regions: RegionMap | None, cutoff: float) -> Layout:
    """Find what is rendered where, and group it."""
    tiles = find_tiles(regions, field.size)
    gaussian, tile = list_gaussians(field, regions, tiles, cutoff)
    used = gaussian.unique()
    # neighbours get neighbouring numbers, so that lists are stored as small steps
    column, row = (field.means.detach().cpu()[used] / TILE).floor().double().unbind(-1)
    used = used[torch.argsort(row * (1 + 2 * column.abs().amax()) + column, stable=True)] if len(used) else used
    number = torch.full((len(field),), -1)
    number[used] = torch.arange(len(used))
    entry = number[gaussian]
    order = torch.argsort(tile * len(field) + entry)
    gaussians = _read(field, regions, used)
    narrow = _is_narrow(gaussians.cholesky, _NARROW if cutoff >= _FAINT else _NARROW_OF_FAINT)
    pairs = torch.stack([entry, tile])[:, torch.argsort(entry * len(tiles.regions) + tile)].numpy()
    return Layout(tiles, gaussians, _group_tiles(tile[order], entry[order], tiles, narrow), pairs)


def _read(field: GaussianField, regions: RegionMap | None, used: Tensor) -> Gaussians:
    means, cholesky, colors = (
        t.detach().float().cpu()[used].numpy() for t in (field.means, field.cholesky, field.merged_colors())
    )
    region = np.zeros(len(means), np.int64)
    if regions is not None and field.region_ids is not None:
        region = regions.index_of(field.region_ids).cpu()[used].numpy()
    return Gaussians(means, cholesky, colors, region)


def _group_tiles(tile: Tensor, entry: Tensor, tiles: Tiles, narrow: NDArray[np.bool_]) -> list[Group]:
    """Sort tiles into groups so that little is filled up and there are few groups."""
    numbers, counts = torch.unique_consecutive(tile, return_counts=True)
    kinds: dict[tuple[int, bool], list[tuple[int, Integers]]] = {}
    for number, part in zip(numbers.tolist(), entry.split(counts.tolist()), strict=True):
        entries = part.numpy()
        regions = len(tiles.regions[number]) if number in tiles.windows else 1
        # few kinds: counts of regions rise by powers of two
        kind = (1 << (regions - 1).bit_length(), bool(narrow[entries].any()))
        kinds.setdefault(kind, []).append((number, entries))
    return [_make_group(part, *kind) for kind, lists in sorted(kinds.items()) for part in _split_by_length(lists)]


def _is_narrow(cholesky: Floats, width: float) -> NDArray[np.bool_]:
    l11, l21, l22 = cholesky.astype(np.float64).T
    steepest: NDArray[np.float64] = np.hypot(np.hypot(1 / l11, l21 / (l11 * l22)), 1 / l22)
    return steepest * width > 1


def _split_by_length(lists: list[tuple[int, Integers]]) -> list[list[tuple[int, Integers]]]:
    """Cut the lists, sorted by length, where that costs least: the best cuts by dynamic programming."""
    lists = sorted(lists, key=lambda item: len(item[1]))
    lengths, first = np.unique([len(entries) for _, entries in lists], return_index=True)
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


def _make_group(lists: list[tuple[int, Integers]], regions: int, narrow: bool) -> Group:
    tiles, lengths = np.array([[tile, len(entries)] for tile, entries in lists]).T
    entries = np.stack([np.pad(entries, (0, lengths.max() - len(entries)), mode="edge") for _, entries in lists])
    return Group(tiles, entries, lengths, regions, narrow)


def find_tiles(regions: RegionMap | None, size: tuple[int, int]) -> Tiles:
    """Find the regions of every tile."""
    rows, cols = -(-size[0] // TILE), -(-size[1] // TILE)
    if regions is None or regions.num_regions == 1:
        return Tiles(rows, cols, [[0]] * (rows * cols), {})
    find = _hard_windows if regions.softness == 0.0 else _soft_windows
    return Tiles(rows, cols, *find(regions, rows, cols))


def margin(supersample: int) -> int:
    """Labels around a tile that its pixels may be sampled from: those next to it, and half a pixel of fine ones."""
    return 1 if supersample == 1 else supersample // 2 + 1


def _hard_windows(regions: RegionMap, rows: int, cols: int) -> tuple[list[list[int]], dict[int, Tensor]]:
    grid, side = regions.membership.grid[0].long().cpu(), TILE * regions.supersample
    halo = margin(regions.supersample)
    down, across = (
        (torch.arange(n)[:, None] * side + torch.arange(-halo, side + halo)).clamp(0, length - 1)
        for n, length in zip((rows, cols), grid.shape, strict=True)
    )
    found: list[list[int]] = []
    windows: dict[int, Tensor] = {}
    for y, x in product(down, across):
        present, window = torch.unique(grid[y[:, None], x], return_inverse=True)
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


def list_gaussians(
    field: GaussianField, regions: RegionMap | None, tiles: Tiles, cutoff: float
) -> tuple[Tensor, Tensor]:
    """Pair Gaussians, (P,), with the tiles, (P,), that they reach, between pixels too, and that hold their region."""
    means, cholesky = (t.detach().double().cpu() for t in (field.means, field.cholesky))
    radius = support_radius(cutoff, torch.float32)
    gaussian, place, origin = bounding_tiles(means, cholesky, radius, field.size, between=True)
    tile = place[:, 1] * tiles.cols + place[:, 0]
    keep = torch.ones_like(tile, dtype=torch.bool)
    if regions is not None:
        assert field.region_ids is not None
        region = regions.index_of(field.region_ids).cpu()[gaussian]
        keys = [number * regions.num_regions + r for number, found in enumerate(tiles.regions) for r in found]
        keep = find_keys(torch.tensor(keys), tile, region, regions.num_regions)[1]
    parts = zip(origin[keep].split(_CHUNK), gaussian[keep].split(_CHUNK), strict=True)
    distance = torch.cat([_nearest(offset, cholesky[part]) for offset, part in parts])
    keep[keep.clone()] = distance <= radius * radius * (1 + 1e-5) + 1e-6
    return gaussian[keep], tile[keep]


def _nearest(offset: Tensor, cholesky: Tensor) -> Tensor:
    """Least squared whitened distance from Gaussians (P, 3) to the points of tiles; `offset`, (P, 2), is to centres."""
    l11, l21, l22 = cholesky.unbind(-1)
    x, y = offset.unbind(-1)
    half = TILE / 2
    inside = (x.abs() <= half) & (y.abs() <= half)
    k1, k3, k4 = 1 / l11, -l21 / (l11 * l22), 1 / l22
    least = torch.full_like(x, torch.inf)
    for sign in (-half, half):
        # along a vertical side z is affine in y, along a horizontal one in x
        z1, base = (x + sign) * k1, (x + sign) * k3
        low = (-base / k4).clamp(y - half, y + half)
        least = torch.minimum(least, z1 * z1 + (base + low * k4) ** 2)
        base = (y + sign) * k4
        low = (-base * k3 / (k1 * k1 + k3 * k3)).clamp(x - half, x + half)
        least = torch.minimum(least, (low * k1) ** 2 + (base + low * k3) ** 2)
    return torch.where(inside, 0.0, least)
