"""What a decoder stores of a scene: its Gaussians, and its tiles in groups whose lists are of similar length."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.kernels.tiles import TILE
from kcgs.nn import GaussianField

from .tiles import Tiles, find_tiles, list_gaussians

# what a group of lists costs beside its entries, in entries
_GROUP_COST = 450
# rounding of a polynomial shows in log w where a Gaussian is narrow: pixels, where weights down to a hundred-thousandth
# are wanted, and below that
_NARROW, _NARROW_OF_FAINT = 0.15, 0.4
_FAINT = 1e-5

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]


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
    return Layout(tiles, gaussians, _group_tiles(tile[order], entry[order], tiles, narrow))


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
