"""What each tile of a scene is drawn from: its Gaussians, its regions and their weights; computed once, in float64."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.kernels.whitened import support_radius
from kcgs.nn import GaussianField

TILE = 16
_CHUNK = 1 << 20


class Tiles(NamedTuple):
    """A scene's tiles in raster order, and the windows that memberships are sampled from.

    A window is a tile and `margin` pixels around it, held at the image's border; of hard contours it is of labels,
    which may be finer than pixels.
    """

    rows: int
    cols: int
    regions: list[list[int]]  # of each tile, positions in the map: those with any share in its window
    windows: dict[int, Tensor]  # of each tile with several regions: [K, side, side] shares (soft), or [side, side]
    # positions in the tile's list of regions (hard)


class Entries(NamedTuple):
    """Which Gaussian is drawn in which tile, sorted by tile, then by Gaussian."""

    gaussian: Tensor  # [P] int64
    tile: Tensor  # [P] int64


def find_tiles(regions: RegionMap | None, size: tuple[int, int]) -> Tiles:
    """Find the regions of every tile."""
    rows, cols = -(-size[0] // TILE), -(-size[1] // TILE)
    if regions is None or regions.num_regions == 1:
        return Tiles(rows, cols, [[0]] * (rows * cols), {})
    if regions.softness == 0.0:
        return _hard_tiles(regions, rows, cols)
    return _soft_tiles(regions, rows, cols)


def margin(supersample: int) -> int:
    """Labels around a tile that its pixels may be sampled from: those next to it, and half a pixel of fine ones."""
    return 1 if supersample == 1 else supersample // 2 + 1


def _hard_tiles(regions: RegionMap, rows: int, cols: int) -> Tiles:
    membership = regions.membership
    grid, side = membership.grid[0].long().cpu(), TILE * membership.supersample
    halo = margin(membership.supersample)
    reach = torch.arange(-halo, side + halo)
    down, across = (
        (torch.arange(n)[:, None] * side + reach).clamp(0, length - 1)
        for n, length in zip((rows, cols), grid.shape, strict=True)
    )
    found: list[list[int]] = []
    windows: dict[int, Tensor] = {}
    for y in down:
        strip = grid[y]
        for x in across:
            window = strip[:, x]
            held = torch.unique(window)
            if len(held) > 1:
                windows[len(found)] = torch.searchsorted(held, window.contiguous())
            found.append(held.tolist())
    return Tiles(rows, cols, found, windows)


def _soft_tiles(regions: RegionMap, rows: int, cols: int) -> Tiles:
    membership = regions.membership
    height, width = regions.size
    # a window sees the tiles around it
    table = membership.tiles(TILE)
    near: list[set[int]] = [set() for _ in range(rows * cols)]
    for key in table.keys.tolist():
        tile, region = divmod(key, membership.num_regions)
        y, x = divmod(tile, cols)
        for there_y in range(max(0, y - 1), min(rows, y + 2)):
            for there_x in range(max(0, x - 1), min(cols, x + 2)):
                near[there_y * cols + there_x].add(region)
    pairs = [(tile, region) for tile, held in enumerate(near) if len(held) > 1 for region in sorted(held)]
    found = [sorted(held) for held in near]
    if not pairs:
        return Tiles(rows, cols, found, {})
    tile, region = torch.tensor(pairs).T
    down, across = (
        torch.arange(-1, TILE + 1).add(at[:, None] * TILE).clamp(0, length - 1)
        for at, length in ((torch.arange(rows), height), (torch.arange(cols), width))
    )
    y, x = (tile // cols), (tile % cols)
    device = membership.index.device
    shares = membership.window_weights(
        torch.zeros_like(tile).to(device),
        region.to(device),
        (y * TILE - 1).to(device),
        (x * TILE - 1).to(device),
        (TILE + 2, TILE + 2),
    ).cpu()
    # rows and columns beyond the border are those at the border
    shares = shares.gather(1, (down[y] - y[:, None] * TILE + 1)[:, :, None].expand_as(shares))
    shares = shares.gather(2, (across[x] - x[:, None] * TILE + 1)[:, None, :].expand_as(shares))
    windows: dict[int, Tensor] = {}
    some = shares.flatten(1).amax(1) > 0
    for t in tile.unique().tolist():
        own = ((tile == t) & some).nonzero().flatten()
        found[t] = region[own].tolist()
        if len(own) > 1:
            windows[t] = shares[own]
    return Tiles(rows, cols, found, windows)


def list_gaussians(field: GaussianField, regions: RegionMap | None, tiles: Tiles, cutoff: float) -> Entries:
    """Find the tiles that each Gaussian reaches, anywhere between their pixels too, and that hold its region."""
    means = field.means.detach().double().cpu()
    l11, l21, l22 = field.cholesky.detach().double().cpu().unbind(-1)
    radius = support_radius(cutoff, torch.float32)
    extent = torch.stack([l11, torch.hypot(l21, l22)], -1) * (radius * (1 + 1e-5)) + 1e-3
    last = torch.tensor([tiles.cols - 1, tiles.rows - 1])
    first, final = (((means + sign * extent) / TILE).floor() for sign in (-1, 1))
    seen = ((final >= 0) & (first <= last)).all(-1)
    first, final = (at.clamp(torch.zeros(2), last.double()).long() for at in (first, final))
    across, down = (final - first + 1).unbind(-1)
    counts = torch.where(seen, across * down, 0)
    gaussian = torch.repeat_interleave(counts)
    rank = torch.arange(len(gaussian)) - (counts.cumsum(0) - counts)[gaussian]
    x, y = first[gaussian, 0] + rank % across[gaussian], first[gaussian, 1] + rank // across[gaussian]
    tile = y * tiles.cols + x
    keep = torch.ones_like(tile, dtype=torch.bool)
    if regions is not None:
        assert field.region_ids is not None
        own = regions.index_of(field.region_ids).cpu()[gaussian]
        held = torch.tensor(sorted(t * regions.num_regions + r for t, ids in enumerate(tiles.regions) for r in ids))
        keep = torch.isin(tile * regions.num_regions + own, held) & (own >= 0)
    gaussian, tile, x, y = (part[keep] for part in (gaussian, tile, x, y))
    centre = (torch.stack([x, y], -1) + 0.5) * TILE
    near = torch.cat(
        [
            _nearest(c, torch.stack([l11, l21, l22], -1)[g]) <= radius * radius * (1 + 1e-5) + 1e-6
            for c, g in zip((centre - means[gaussian]).split(_CHUNK), gaussian.split(_CHUNK), strict=True)
        ]
    )
    gaussian, tile = gaussian[near], tile[near]
    order = torch.argsort(tile * len(means) + gaussian)
    return Entries(gaussian[order], tile[order])


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
        at = (-base / k4).clamp(y - half, y + half)
        least = torch.minimum(least, z1 * z1 + (base + at * k4) ** 2)
        base = (y + sign) * k4
        at = (-base * k3 / (k1 * k1 + k3 * k3)).clamp(x - half, x + half)
        least = torch.minimum(least, (at * k1) ** 2 + (base + at * k3) ** 2)
    return torch.where(inside, 0.0, least)
