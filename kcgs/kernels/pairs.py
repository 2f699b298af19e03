"""The (Gaussian, tile) pairs that `tiled` and `cuda` evaluate: tiles of pixels, and of wide Gaussians' coarse grids."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .coarse_grids import Coarsened, Grid, blocks_of, choose_levels, coarsen, grids_of, max_spacing, uncoarsen
from .interface import Gradients, SplatInputs
from .splines import Nodes, find_nodes
from .tiles import TILE, bounding_tiles, coefficients, find_keys, grid_of, reaches
from .whitened import sums_to_gradients, support_radius


class Wide(NamedTuple):
    """The Gaussians on coarse grids."""

    ids: Tensor  # [M] int64, b * N + i
    gaussians: Coarsened
    nodes: Nodes


class Pairs(NamedTuple):
    """One entry for every (Gaussian, tile) that may give a weight, ordered by Gaussian.

    Tiles are those of pixels, then the live blocks of nodes, and, if there are any, one that stays empty.
    """

    gaussian: Tensor  # [P] int64, b * N + i
    tile: Tensor  # [P] int64
    mask_rows: Tensor | None  # [P] int64 row of TileMembership.masks, -1: weight 1; None where no map is used
    coefficients: Tensor  # [P, 5], in the dtype of the inputs: see tiles.coefficients
    cholesky: Tensor  # [B * N, 3] float64, as the Gaussians are evaluated
    num_tiles: int
    wide: Wide | None  # None: all is evaluated at the pixels


def list_pairs(inputs: SplatInputs) -> Pairs:
    """List the tiles and blocks that each Gaussian's support touches and that hold its region."""
    means, cholesky = (t.detach().double().flatten(0, 1) for t in inputs[:2])
    grids = grids_of(inputs.size, 1 if inputs.membership is None else len(inputs.membership.index))
    level = choose_levels(cholesky, max_spacing(inputs.cutoff), len(grids))
    ids = level.nonzero().flatten()
    if not len(ids):
        return _pairs_on(grids[0], inputs, means, cholesky)[0]
    coarse = coarsen(level[ids], means[ids], cholesky[ids])
    means, cholesky = means.index_copy(0, ids, coarse.means), cholesky.index_copy(0, ids, coarse.cholesky)
    pairs, block = _pairs_on(torch.tensor(grids, device=means.device)[level], inputs, means, cholesky)

    blocks = blocks_of(inputs.membership, inputs.size, means.device)
    on_nodes = (block >= blocks.first).nonzero().flatten()
    position = block[on_nodes] - blocks.first
    copies = 1
    if inputs.membership is None or len(inputs.membership.index) == 1:
        copies = len(inputs.means)
        position += pairs.gaussian[on_nodes] // inputs.means.shape[1] * (len(blocks.keys) - blocks.first + 1)
    nodes = find_nodes(blocks, inputs.membership, position, copies)
    pairs.tile[on_nodes] = nodes.number.view(-1)[position] + pairs.num_tiles
    return pairs._replace(num_tiles=pairs.num_tiles + nodes.num_live + 1, wide=Wide(ids, coarse, nodes))


def _pairs_on(grid: Grid | Tensor, inputs: SplatInputs, means: Tensor, cholesky: Tensor) -> tuple[Pairs, Tensor]:
    """List pairs as if all tiles were of pixels; return their positions among the blocks of the map too.

    The grid is that of all Gaussians, or of each, (B * N, 5) with columns as in Grid.
    """
    radius, pixel_grid = support_radius(inputs.cutoff, inputs.means.dtype), grid_of(inputs)
    size = grid[:2] if isinstance(grid, Grid) else grid[:, :2]
    gaussian, place, origin = bounding_tiles(means, cholesky, radius, size)
    is_touched, image = reaches(origin, cholesky[gaussian], radius), gaussian // inputs.means.shape[1]
    col, row = place.unbind(1)
    tile = (image * pixel_grid.rows + row) * pixel_grid.cols + col

    rows, cols, first = grid[2:] if isinstance(grid, Grid) else grid[gaussian, 2:].unbind(-1)
    if inputs.membership is not None and len(inputs.membership.index) > 1:
        row = image * rows + row
    block, mask_rows = row * cols + col + first, None
    if inputs.membership is not None and inputs.region_index is not None:
        table, region = inputs.membership.tiles(TILE), inputs.region_index.flatten()[gaussian]
        keys, mask_rows = table.keys, table.mask_rows
        if not isinstance(grid, Grid):
            keys = blocks_of(inputs.membership, inputs.size, means.device).keys
            # blocks of nodes come after those of pixels, and have no masks
            mask_rows = torch.nn.functional.pad(mask_rows, (0, len(keys) - len(mask_rows)), value=-1)
        block, is_present = find_keys(keys, block, region, inputs.membership.num_regions)
        is_touched &= is_present
    indices = is_touched.nonzero().flatten()
    gaussian, tile, block, origin = (t.index_select(0, indices) for t in (gaussian, tile, block, origin))
    mask_rows = None if mask_rows is None else mask_rows[block]
    affine = coefficients(origin, cholesky[gaussian]).to(inputs.means.dtype)
    return Pairs(gaussian, tile, mask_rows, affine, cholesky, pixel_grid.total, None), block


def colors_of(pairs: Pairs, inputs: SplatInputs) -> Tensor:
    """Return the colours with which the Gaussians are evaluated, (B * N, C)."""
    return _scale(inputs.colors.detach().flatten(0, 1), pairs.wide)


def _scale(colors: Tensor, wide: Wide | None) -> Tensor:
    if wide is None:
        return colors
    scaled = colors[wide.ids] * wide.gaussians.factor[:, None]
    return colors.index_copy(0, wide.ids, scaled.to(colors.dtype))


def gradients_of(pairs: Pairs, inputs: SplatInputs, sums: Tensor) -> Gradients:
    """Turn sums over pixels and nodes, (B * N, C) or (B * N, C + 5), into gradients: see `sums_to_gradients`."""
    shape, channels = inputs.means.shape[:2], inputs.colors.shape[-1]
    if pairs.wide is None:
        return sums_to_gradients(sums.unflatten(0, shape), channels, inputs.cholesky)
    ids, coarse, _ = pairs.wide
    means, cholesky, colors = sums_to_gradients(sums, channels, pairs.cholesky)
    if means is not None and cholesky is not None:
        fine, fine_colors = (t.detach().flatten(0, 1)[ids].double() for t in inputs[1:3])
        factor = (colors[ids] * fine_colors).sum(-1)
        by_fine = uncoarsen(fine, coarse, means[ids], cholesky[ids], factor)
        means, cholesky = (
            t.index_copy(0, ids, gradient).to(colors.dtype).unflatten(0, shape)
            for t, gradient in zip((means, cholesky), by_fine, strict=True)
        )
    return means, cholesky, _scale(colors, pairs.wide).unflatten(0, shape)
