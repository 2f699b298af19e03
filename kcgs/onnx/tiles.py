"""The tiles of a scene, for `plan`: the regions of each, and the labels or memberships of the pixels around it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.kernels.tiles import TILE
from kcgs.maps import Membership, SmoothMembership

# side of a window: a tile and the pixels around it, those of the border of the scene repeated beyond it
WINDOW = TILE + 2


class Tiles(NamedTuple):
    """The tiles of a scene in raster order, and the windows of those with several regions."""

    rows: int
    cols: int
    regions: list[list[int]]  # of each tile, positions in the map: those with any membership in its window
    windows: dict[int, Tensor]  # [K, WINDOW, WINDOW] weights of `SmoothMembership`, by tile


def find_tiles(regions: RegionMap | None, size: tuple[int, int]) -> Tiles:
    """Find the regions of every tile."""
    rows, cols = -(-size[0] // TILE), -(-size[1] // TILE)
    if regions is None or regions.num_regions == 1:
        return Tiles(rows, cols, [[0]] * (rows * cols), {})
    membership, count = smooth_membership(regions), regions.num_regions
    keys = membership.tiles(TILE).keys.cpu()
    # a window reaches into the tiles around it
    steps = torch.arange(-1, 2)
    y = (keys // count // cols)[:, None, None] + steps[:, None]
    x = (keys // count % cols)[:, None, None] + steps
    inside = (y >= 0) & (y < rows) & (x >= 0) & (x < cols)
    keys = ((y * cols + x) * count + (keys % count)[:, None, None])[inside].unique()
    tile, region = keys // count, keys % count
    mixed = torch.bincount(tile)[tile] > 1
    windows = cut_memberships(membership, tile[mixed], cols, region[mixed])
    positive = windows.flatten(1).amax(1) > 0
    present = ~mixed
    present[mixed] = positive
    lists = region[present].split(torch.bincount(tile[present]).tolist())
    numbers, counts = tile[mixed][positive].unique_consecutive(return_counts=True)
    parts = zip(numbers.tolist(), windows[positive].split(counts.tolist()), strict=True)
    several = {number: part for number, part in parts if len(part) > 1}
    return Tiles(rows, cols, [part.tolist() for part in lists], several)


def smooth_membership(regions: RegionMap) -> Membership:
    """Return what is interpolated between the pixels of a map."""
    return regions.tables.membership.derived("smooth", SmoothMembership)


def cut_memberships(membership: Membership, tile: Tensor, cols: int, region: Tensor) -> Tensor:
    """Evaluate a region over the window of a tile, (P, WINDOW, WINDOW), for P pairs of both."""
    corners = tile // cols * TILE - 1, tile % cols * TILE - 1
    place = torch.stack([torch.zeros_like(region), *corners], 1)
    weights = membership.window_weights(place, region, (WINDOW, WINDOW)).cpu()
    down, across = (
        (begin[:, None] + torch.arange(WINDOW)).clamp(0, length - 1) - begin[:, None]
        for begin, length in zip(corners, membership.index.shape[1:], strict=True)
    )
    return weights.gather(1, down[:, :, None].expand_as(weights)).gather(2, across[:, None, :].expand_as(weights))
