"""What the tiled kernels evaluate, as one list: Gaussians in tiles of pixels, and wide ones in blocks of nodes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .inputs import Gradients, SplatInputs
from .nodes import Nodes, find_nodes
from .octaves import Coarsened, Grid, blocks_of, choose_levels, coarsen, grids_of, most_spacing, uncoarsen
from .tiles import TILE, bounding_tiles, coefficients, find_keys, grid_of, reaches
from .whitened import sums_to_gradients, support_radius


class Wide(NamedTuple):
    """The Gaussians on coarse grids."""

    which: Tensor  # [M] int64, b * N + i
    gaussians: Coarsened
    nodes: Nodes


class Bins(NamedTuple):
    """One entry for every (Gaussian, tile) that may give a weight, ordered by Gaussian.

    Tiles are those of pixels, then the live blocks of nodes, and, if there are any, one that stays empty.
    """

    gaussian: Tensor  # [P] int64, b * N + i
    tile: Tensor  # [P] int64
    mask: Tensor | None  # [P] int64 row of TileMembership.masks, -1: weight 1; None where no map is used
    coefficients: Tensor  # [P, 5], in the dtype of the inputs: see tiles.coefficients
    cholesky: Tensor  # [B * N, 3] float64, as the Gaussians are evaluated
    total: int  # number of tiles
    wide: Wide | None  # None: all is evaluated at the pixels


def bin_gaussians(inputs: SplatInputs) -> Bins:
    """List the tiles and blocks that each Gaussian's support touches and that hold its region."""
    means, cholesky = (t.detach().double().flatten(0, 1) for t in inputs[:2])
    grids = grids_of(inputs.size, 1 if inputs.membership is None else len(inputs.membership.index))
    level = choose_levels(cholesky, most_spacing(inputs.cutoff), len(grids))
    which = level.nonzero().flatten()
    if not len(which):
        return _list_pairs(inputs, means, cholesky, grids[0])[0]
    coarse = coarsen(level[which], means[which], cholesky[which])
    means, cholesky = means.index_copy(0, which, coarse.means), cholesky.index_copy(0, which, coarse.cholesky)
    bins, block = _list_pairs(inputs, means, cholesky, torch.tensor(grids, device=means.device)[level])

    blocks = blocks_of(inputs.membership, inputs.size, means.device)
    pairs = (block >= blocks.first).nonzero().flatten()
    place = block[pairs] - blocks.first
    copies = 1
    if inputs.membership is None or len(inputs.membership.index) == 1:
        copies = len(inputs.means)
        place += bins.gaussian[pairs] // inputs.means.shape[1] * (len(blocks.keys) - blocks.first + 1)
    nodes = find_nodes(blocks, inputs.membership, place, copies)
    bins.tile[pairs] = nodes.number.view(-1)[place] + bins.total
    return bins._replace(total=bins.total + nodes.live + 1, wide=Wide(which, coarse, nodes))


def _list_pairs(inputs: SplatInputs, means: Tensor, cholesky: Tensor, grid: Grid | Tensor) -> tuple[Bins, Tensor]:
    """List pairs as if all tiles were of pixels; return their positions among the blocks of the map too.

    The grid is that of all Gaussians, or of each, (B * N, 5) with columns as in Grid.
    """
    radius, of_pixels = support_radius(inputs.cutoff, inputs.means.dtype), grid_of(inputs)
    size = grid[:2] if isinstance(grid, Grid) else grid[:, :2]
    gaussian, place, origin = bounding_tiles(means, cholesky, radius, size)
    keep, image = reaches(origin, cholesky[gaussian], radius), gaussian // inputs.means.shape[1]
    col, row = place.unbind(1)
    tile = (image * of_pixels.rows + row) * of_pixels.cols + col

    rows, cols, first = grid[2:] if isinstance(grid, Grid) else grid[gaussian, 2:].unbind(-1)
    if inputs.membership is not None and len(inputs.membership.index) > 1:
        row = image * rows + row
    block, masks = row * cols + col + first, None
    if inputs.membership is not None and inputs.region_index is not None:
        table, region = inputs.membership.tiles(TILE), inputs.region_index.flatten()[gaussian]
        keys, masks = table.keys, table.mask
        if not isinstance(grid, Grid):
            keys = blocks_of(inputs.membership, inputs.size, means.device).keys
            # blocks of nodes come after those of pixels, and have no masks
            masks = torch.nn.functional.pad(masks, (0, len(keys) - len(masks)), value=-1)
        block, present = find_keys(keys, block, region, inputs.membership.num_regions)
        keep &= present
    keep = keep.nonzero().flatten()
    gaussian, tile, block, origin = (t.index_select(0, keep) for t in (gaussian, tile, block, origin))
    mask = None if masks is None else masks[block]
    frame = coefficients(origin, cholesky[gaussian]).to(inputs.means.dtype)
    return Bins(gaussian, tile, mask, frame, cholesky, of_pixels.total, None), block


def colors_of(bins: Bins, inputs: SplatInputs) -> Tensor:
    """Return the colours with which the Gaussians are evaluated, (B * N, C)."""
    return _scale(inputs.colors.detach().flatten(0, 1), bins.wide)


def _scale(colors: Tensor, wide: Wide | None) -> Tensor:
    if wide is None:
        return colors
    scaled = colors[wide.which] * wide.gaussians.factor[:, None]
    return colors.index_copy(0, wide.which, scaled.to(colors.dtype))


def to_gradients(bins: Bins, inputs: SplatInputs, sums: Tensor) -> Gradients:
    """Turn sums over pixels and nodes, (B * N, C) or (B * N, C + 5), into gradients: see `sums_to_gradients`."""
    shape, channels = inputs.means.shape[:2], inputs.colors.shape[-1]
    if bins.wide is None:
        return sums_to_gradients(sums.unflatten(0, shape), channels, inputs.cholesky)
    which, coarse, _ = bins.wide
    means, cholesky, colors = sums_to_gradients(sums, channels, bins.cholesky)
    if means is not None and cholesky is not None:
        given, given_colors = (t.detach().flatten(0, 1)[which].double() for t in inputs[1:3])
        factor = (colors[which] * given_colors).sum(-1)
        rows = uncoarsen(given, coarse, means[which], cholesky[which], factor)
        means, cholesky = (
            t.index_copy(0, which, new).to(colors.dtype).unflatten(0, shape)
            for t, new in zip((means, cholesky), rows, strict=True)
        )
    return means, cholesky, _scale(colors, bins.wide).unflatten(0, shape)
