"""The plan of a decoder, without ONNX: the Gaussians that it stores, and the tiles in which they are rendered."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.kernels import Blocks, Coarsened, make_blocks
from kcgs.maps import TILE, RegionMap
from kcgs.nn import GaussianField

from .groups import Group, Integers, group_tiles
from .reach import pair_with_blocks, place_gaussians
from .tiles import Tiles, find_tiles

# cost of coarse grids, in entries of lists: they must save more entries. Tune both by the times of
# `python -m benchmarks decode`
_GRIDS_COST = 2000  # constant cost
_SPLINE_COST = 7  # cost of each pair of tile and region
# Gaussians with a smaller standard deviation, in pixels, sum squares: the rounding of a polynomial log w would show
_NARROW = 0.15
_NARROW_OF_FAINT = 0.4  # if weights below _FAINT are rendered too
_FAINT = 1e-5

Floats = NDArray[np.float32]


class GaussianTable(NamedTuple):
    """The Gaussians that reach a pixel; on coarse grids in units of the nodes' spacing."""

    means: Floats  # [N, 2]
    cholesky: Floats  # [N, 3]
    colors: Floats  # [N, C], opacities merged
    region: Integers  # [N], index of the region in the map


class NodeBlocks(NamedTuple):
    """The blocks of coarse grids that some Gaussian reaches, and the shape of the table of all possible blocks."""

    place: Integers  # [n, 4] level - 1, region, row and column, ascending
    shape: tuple[int, int, int, int]  # levels, regions, rows, columns; with one empty level and one empty region more

    @property
    def no_region(self) -> int:
        """Index of the region without nodes."""
        return self.shape[1] - 1


class DecoderPlan(NamedTuple):
    """The contents of a decoder."""

    tiles: Tiles
    gaussians: GaussianTable
    groups: list[Group]  # groups of blocks of nodes come last
    pairs: Integers  # [2, P] Gaussian and tile of every entry, in this order
    nodes: NodeBlocks | None  # None: no coarser grids

    @property
    def num_blocks(self) -> int:
        """Number of tiles and blocks of nodes."""
        return len(self.tiles.regions) + (0 if self.nodes is None else len(self.nodes.place))

    @property
    def mixed_tiles(self) -> dict[int, Integers]:
        """Tiles with several regions by their number of regions: (T,) each, in the order of groups."""
        kinds = sorted({group.regions for group in self.groups} - {1})
        parts = {kind: [group.tiles for group in self.groups if group.regions == kind] for kind in kinds}
        return {kind: np.concatenate(tiles) for kind, tiles in parts.items()}

    @property
    def pixel_groups(self) -> list[Group]:
        """The groups of tiles, without those of blocks of nodes."""
        return [group for group in self.groups if not group.nodes]


def plan_decoder(field: GaussianField, regions: RegionMap | None, cutoff: float) -> DecoderPlan:
    """Find the Gaussians that reach each tile or block of nodes, and group the tiles and blocks."""
    tiles = find_tiles(regions, field.size)
    num_regions = 1 if regions is None else regions.num_regions
    region = torch.zeros(field.num_gaussians, dtype=torch.int64)
    if regions is not None and field.region_ids is not None:
        region = regions.index_of(field.region_ids).cpu()
    starts = np.cumsum([0, *map(len, tiles.regions)])
    blocks = make_blocks(starts, np.concatenate(tiles.regions), num_regions, (1, *field.size))
    coarsened, gaussian, block = _pair(field, region, num_regions, blocks, cutoff)
    nodes, number = _number_blocks(blocks, num_regions, tiles, block)
    tile = number[block]

    ids = _in_raster_order(coarsened, gaussian.unique())
    entry = torch.full((field.num_gaussians,), -1)
    entry[ids] = torch.arange(len(ids))
    entry = entry[gaussian]
    merged = field.merged_colors().detach().double().cpu() * coarsened.factor[:, None]
    means, cholesky, colors = (t[ids].float().numpy() for t in (coarsened.means, coarsened.cholesky, merged))
    gaussians = GaussianTable(means, cholesky, colors, region[ids].numpy())
    narrow = _is_narrow(gaussians.cholesky, _NARROW if cutoff >= _FAINT else _NARROW_OF_FAINT)
    pairs = torch.stack([entry, tile])[:, torch.argsort(entry * len(number) + tile)].numpy()
    groups = group_tiles(pairs, narrow, tiles, 0 if nodes is None else len(nodes.place))
    return DecoderPlan(tiles, gaussians, groups, pairs, nodes)


def _pair(
    field: GaussianField, region: Tensor, num_regions: int, blocks: Blocks, cutoff: float
) -> tuple[Coarsened, Tensor, Tensor]:
    """Pair Gaussians with blocks of pixels; pair wide Gaussians with blocks of nodes if this saves enough pairs."""
    means, cholesky = (t.detach().double().cpu() for t in (field.means, field.cholesky))
    fine = place_gaussians(means, cholesky, cutoff, 1)
    gaussian, block = pair_with_blocks(fine, region, num_regions, blocks, cutoff)
    coarse = place_gaussians(means, cholesky, cutoff, len(blocks.grids))
    saved = int((coarse.level[gaussian] > 0).sum())
    if saved <= _GRIDS_COST + _SPLINE_COST * blocks.levels[1]:
        return fine, gaussian, block
    return coarse, *pair_with_blocks(coarse, region, num_regions, blocks, cutoff)


def _number_blocks(blocks: Blocks, num_regions: int, tiles: Tiles, block: Tensor) -> tuple[NodeBlocks | None, Tensor]:
    """Return the blocks of nodes that Gaussians reach, directly or through coarser blocks, and all blocks' numbers."""
    number, levels = torch.from_numpy(blocks.tiles), blocks.levels
    is_needed = torch.zeros(len(number) + 1, dtype=torch.bool)
    is_needed[block] = True
    if not is_needed[levels[1] :].any():
        return None, number
    for first, end in reversed(list(pairwise(levels[1:]))):
        is_needed[first:end] |= is_needed[blocks.parents[first:end]].any(1)
    ids = is_needed[levels[1] : -1].nonzero()[:, 0] + levels[1]
    level = torch.searchsorted(torch.tensor(levels[1:]), ids, right=True) - 1
    cols, first_tile = torch.tensor([[grid.cols, grid.first_tile] for grid in blocks.grids[1:]])[level].T
    tile, region = number[ids] - first_tile, torch.from_numpy(blocks.regions)[ids]
    place = torch.stack([level, region, tile // cols, tile % cols], -1).numpy()
    order = np.lexsort(place.T[::-1])
    number[ids[order]] = len(tiles.regions) + torch.arange(len(place))
    shape = (int(level.max()) + 2, num_regions + 1, tiles.rows // 2 + 1, tiles.cols // 2 + 1)
    return NodeBlocks(place[order], shape), number


def _in_raster_order(coarsened: Coarsened, ids: Tensor) -> Tensor:
    """Sort ids by level and tile, so that neighbours have similar numbers and lists are stored as small steps."""
    if len(ids) == 0:
        return ids
    column, row = (coarsened.means[ids] / TILE).floor().unbind(-1)
    ids = ids[torch.argsort(row * (1 + 2 * column.abs().amax()) + column, stable=True)]
    return ids[torch.argsort(coarsened.level[ids], stable=True)]


def _is_narrow(cholesky: Floats, width: float) -> NDArray[np.bool_]:
    """Return the mask of the Gaussians that are narrower than `width` in some direction."""
    l11, l21, l22 = cholesky.astype(np.float64).T
    steepest: NDArray[np.float64] = np.hypot(np.hypot(1 / l11, l21 / (l11 * l22)), 1 / l22)
    return steepest * width > 1
