"""Which Gaussian touches which tile: the lists that the tiled kernels walk."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .form import Z_LIMIT, support_radius
from .inputs import SplatInputs

TILE = 16


class TileGrid(NamedTuple):
    """Tiles over a batch of images, numbered in raster order, batch first."""

    batch: int
    rows: int
    cols: int

    @property
    def total(self) -> int:
        """Number of tiles over the whole batch."""
        return self.batch * self.rows * self.cols


class Pairs(NamedTuple):
    """One entry for every (Gaussian, tile) that may give a weight, ordered by Gaussian."""

    gaussian: Tensor  # [P] int64, b * N + i
    tile: Tensor  # [P] int64
    plane: Tensor | None  # [P] int64 row of TileMembership.planes, -1: weight 1; None where no map is used
    origin: Tensor  # [P, 2] float64, tile's centre minus the Gaussian's mean


def grid_of(inputs: SplatInputs) -> TileGrid:
    """Tiles that cover the batch."""
    height, width = inputs.size
    return TileGrid(inputs.means.shape[0], -(-height // TILE), -(-width // TILE))


def bin_gaussians(inputs: SplatInputs) -> Pairs:
    """List the tiles that each Gaussian's support touches and that hold its region."""
    grid = grid_of(inputs)
    gaussian, tile_x, tile_y = _bounding_tiles(inputs, grid)
    means = inputs.means.detach().double().flatten(0, 1)
    cholesky = inputs.cholesky.detach().double().flatten(0, 1)
    centre = torch.stack([tile_x, tile_y], -1) * float(TILE) + TILE / 2
    origin = centre - means[gaussian]

    keep = _reaches(origin, cholesky[gaussian], support_radius(inputs.cutoff, inputs.means.dtype))
    image = gaussian // inputs.means.shape[1]
    tile = (image * grid.rows + tile_y) * grid.cols + tile_x
    plane = None
    if inputs.membership is not None and inputs.region_index is not None:
        shared = inputs.membership.index.shape[0] == 1
        local = tile - image * grid.rows * grid.cols if shared else tile
        region = inputs.region_index.flatten()[gaussian]
        plane, present = _find_planes(inputs, local, region)
        keep &= present
        plane = plane[keep]
    return Pairs(gaussian[keep], tile[keep], plane, origin[keep])


def _bounding_tiles(inputs: SplatInputs, grid: TileGrid) -> tuple[Tensor, Tensor, Tensor]:
    height, width = inputs.size
    means = inputs.means.detach().double().flatten(0, 1)
    l11, l21, l22 = inputs.cholesky.detach().double().flatten(0, 1).unbind(-1)
    radius = support_radius(inputs.cutoff, inputs.means.dtype)
    extent = torch.stack([l11, torch.hypot(l21, l22)], -1) * radius * (1 + 1e-5) + 1e-3
    last = torch.tensor([width - 1, height - 1], device=means.device, dtype=means.dtype)
    low = (means - extent - 0.5).ceil()
    high = (means + extent - 0.5).floor()
    seen = ((low <= high) & (high >= 0) & (low <= last)).all(-1)
    first_tile = (low.clamp_min(0).minimum(last) / TILE).floor().long()
    last_tile = (high.clamp_min(0).minimum(last) / TILE).floor().long()
    across, down = (last_tile - first_tile + 1).unbind(-1)
    counts = torch.where(seen, across * down, 0)
    gaussian = torch.repeat_interleave(counts)
    rank = torch.arange(len(gaussian), device=means.device) - (counts.cumsum(0) - counts)[gaussian]
    tile_y = first_tile[gaussian, 1] + rank // across[gaussian]
    tile_x = first_tile[gaussian, 0] + rank % across[gaussian]
    return gaussian, tile_x, tile_y


def _reaches(origin: Tensor, cholesky: Tensor, radius: float) -> Tensor:
    # the bounding box bounds z1; a slanted needle is thin in z2, whose least value over the tile is this
    l11, l21, l22 = cholesky.unbind(-1)
    slope = l21 / l11
    half = (TILE - 1) / 2
    nearest = (origin[:, 1] - slope * origin[:, 0]).abs() - half * (1 + slope.abs())
    return nearest <= radius * (1 + 1e-5) * l22 + 1e-3


def _find_planes(inputs: SplatInputs, tile: Tensor, region: Tensor) -> tuple[Tensor, Tensor]:
    assert inputs.membership is not None
    table = inputs.membership.tiles(TILE)
    key = torch.where(region >= 0, tile * inputs.membership.num_regions + region, -1)
    at = torch.searchsorted(table.keys, key).clamp_max(len(table.keys) - 1)
    return table.plane[at], table.keys[at] == key


def coefficients(pairs: Pairs, inputs: SplatInputs) -> Tensor:
    """Coefficients of z in tile-centred pixels, [P, 5]: z1 = k0 + k1 x, z2 = k2 + k3 x + k4 y; made in float64."""
    l11, l21, l22 = inputs.cholesky.detach().double().flatten(0, 1)[pairs.gaussian].unbind(-1)
    x, y = pairs.origin.unbind(-1)
    slope = l21 / l11
    rows = torch.stack([x / l11, 1 / l11, (y - slope * x) / l22, -slope / l22, 1 / l22], -1)
    return rows.clamp(-Z_LIMIT, Z_LIMIT).to(inputs.means.dtype)


def sum_runs(values: Tensor, counts: Tensor) -> Tensor:
    """Sum consecutive runs of rows: the same order of addition every time, on any device."""
    if len(counts) == 0:
        return values.new_zeros(0, values.shape[-1])
    return torch.segment_reduce(values, "sum", lengths=counts, axis=0, initial=0.0)
