"""Tiles sorted into groups whose lists are of similar length."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .lists import TILE, Entries, Tiles

# what a group of lists costs beside its entries, in entries
_GROUP_COST = 450
# rounding of a polynomial shows in log w where a Gaussian is narrow: pixels, where weights down to a hundred-thousandth
# are wanted, and below that
_NARROW, _NARROW_OF_FAINT = 0.15, 0.4
_FAINT = 1e-5

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
