"""The tiles of a scene, for `plan`: the regions of each tile, and the memberships of the pixels around it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.maps import (
    TILE,
    Membership,
    RegionMap,
    SmoothMembership,
    cut_windows,
    find_windows,
    membership_at,
    table_and_size,
)

# side of a window: a tile and the pixels around it; outside the scene, pixels of its border are repeated
WINDOW = TILE + 2


class Tiles(NamedTuple):
    """The tiles of a scene in raster order."""

    rows: int
    cols: int
    regions: list[list[int]]  # of each tile, indices of the regions that have membership in its window
    several: set[int]  # tiles with several regions
    membership: Membership | None = None  # at the size of the scene
    smooth: SmoothMembership | None = None  # memberships that are interpolated between pixels


def find_tiles(regions: RegionMap | None, size: tuple[int, int]) -> Tiles:
    """Find the regions of every tile."""
    rows, cols = -(-size[0] // TILE), -(-size[1] // TILE)
    if regions is None or regions.num_regions == 1:
        return Tiles(rows, cols, [[0]] * (rows * cols), set())
    membership = membership_at(*table_and_size(regions))
    smooth = SmoothMembership(membership)
    # windows extend into neighbouring tiles
    numbers = torch.arange(rows * cols)
    tile, region = find_windows(smooth.tiled_table, _corners(numbers, cols), (WINDOW, WINDOW))
    mixed = torch.bincount(tile)[tile] > 1
    windows = read_memberships(smooth, tile[mixed], cols, region[mixed])
    positive = windows.flatten(1).amax(1) > 0
    present = ~mixed
    present[mixed] = positive
    counts = torch.bincount(tile[present])
    lists = region[present].split(counts.tolist())
    several = set((counts > 1).nonzero().flatten().tolist())
    return Tiles(rows, cols, [part.tolist() for part in lists], several, membership, smooth)


def _corners(tile: Tensor, cols: int) -> Tensor:
    """Return the map's index (0), first row and first column of the windows of tiles, (T, 3)."""
    return torch.stack([torch.zeros_like(tile), tile // cols * TILE - 1, tile % cols * TILE - 1], 1)


def read_memberships(membership: Membership, tile: Tensor, cols: int, region: Tensor) -> Tensor:
    """Read memberships over windows, (P, WINDOW, WINDOW), for P pairs of tile and region."""
    corners = _corners(tile, cols)
    weights = cut_windows(membership.tiled_table, corners, region, (WINDOW, WINDOW))
    down, across = (
        (begin[:, None] + torch.arange(WINDOW)).clamp(0, length - 1) - begin[:, None]
        for begin, length in zip(corners.unbind(1)[1:], membership.table.size, strict=True)
    )
    return weights.gather(1, down[:, :, None].expand_as(weights)).gather(2, across[:, None, :].expand_as(weights))
