"""What each tile of a scene is rendered from: its Gaussians, its regions and their weights."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.kernels.tiles import TILE, bounding_tiles, find_keys
from kcgs.kernels.whitened import support_radius
from kcgs.nn import GaussianField

_CHUNK = 1 << 20


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
    """Least squared whitened distance between a Gaussian's centre and the points of a tile.

    Args:
        offset: the tile's centre minus the Gaussian's, (P, 2).
        cholesky: (P, 3).
    """
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
