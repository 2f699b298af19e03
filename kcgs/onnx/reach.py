"""Pairs of a Gaussian and a block that it reaches, for `plan`; wide Gaussians reach blocks of nodes, others tiles."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs.kernels import (
    Blocks,
    Coarsened,
    bounding_tiles,
    choose_levels,
    coarsen,
    find_keys,
    max_spacing,
    support_radius,
)
from kcgs.maps import TILE

# pairs of Gaussian and block whose distances are computed at once: 8 MB for each float64 of a pair
_CHUNK = 1 << 20


def place_gaussians(means: Tensor, cholesky: Tensor, cutoff: float, levels: int) -> Coarsened:
    """Move float64 Gaussians to the coarsest of `levels` levels whose nodes are close enough; level 0: the pixels."""
    level = choose_levels(cholesky, max_spacing(cutoff), levels)
    wide = level > 0
    result = Coarsened(level, means.clone(), cholesky.clone(), torch.ones_like(means[:, 0]))
    for values, coarse in zip(result[1:], coarsen(level[wide], means[wide], cholesky[wide])[1:], strict=True):
        values[wide] = coarse
    return result


def pair_with_blocks(
    coarsened: Coarsened, region: Tensor, num_regions: int, blocks: Blocks, cutoff: float
) -> tuple[Tensor, Tensor]:
    """Pair Gaussians, (P,), with the blocks of their level and region that they reach, (P,), also between pixels."""
    radius = support_radius(cutoff, torch.float32)
    keys = torch.from_numpy(blocks.tiles * num_regions + blocks.regions)
    gaussians, numbers = [], []  # of each level
    for level, grid in enumerate(blocks.grids):
        ids = (coarsened.level == level).nonzero()[:, 0]
        means, cholesky, regions = coarsened.means[ids], coarsened.cholesky[ids], region[ids]
        size = (grid.height, grid.width)
        gaussian, column_row, origin = bounding_tiles(means, cholesky, radius, size, between=level == 0)
        tile = grid.first_tile + column_row[:, 1] * grid.cols + column_row[:, 0]
        block, present = find_keys(keys, tile, regions[gaussian], num_regions)
        parts = zip(origin[present].split(_CHUNK), gaussian[present].split(_CHUNK), strict=True)
        distance = torch.cat([_least_distance(offset, cholesky[part]) for offset, part in parts])
        reached = present.clone()
        reached[present] = distance <= radius * radius * (1 + 1e-5) + 1e-6  # with a tolerance for rounding
        gaussians.append(ids[gaussian[reached]])
        numbers.append(block[reached])
    return torch.cat(gaussians), torch.cat(numbers)


def _least_distance(offset: Tensor, cholesky: Tensor) -> Tensor:
    """Return the least squared whitened distance of Gaussians (P, 3) to tiles; `offset`, (P, 2), is to tile centres."""
    l11, l21, l22 = cholesky.unbind(-1)
    x, y = offset.unbind(-1)
    half = TILE / 2
    inside = (x.abs() <= half) & (y.abs() <= half)
    k1, k3, k4 = 1 / l11, -l21 / (l11 * l22), 1 / l22
    least = torch.full_like(x, torch.inf)
    for side in (-half, half):
        # along a vertical side z is affine in y, along a horizontal side in x
        z1, base = (x + side) * k1, (x + side) * k3
        low = (-base / k4).clamp(y - half, y + half)
        least = torch.minimum(least, z1 * z1 + (base + low * k4) ** 2)
        base = (y + side) * k4
        low = (-base * k3 / (k1 * k1 + k3 * k3)).clamp(x - half, x + half)
        least = torch.minimum(least, (low * k1) ** 2 + (base + low * k3) ** 2)
    return torch.where(inside, 0.0, least)
