"""Cubic B-splines of coarse grids in torch, for `tiled` and `cuda`: blocks of nodes are refined and sampled at pixels.

A block of 16 x 16 is made from a window W of 11 x 11 nodes of the coarser grid: M W M^T, one M for all. The window lies
in one block, or in two or four neighbours, where the block is in an odd row or column of tiles.
"""

from __future__ import annotations

import functools
import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from .coarse_grids import Blocks
from .membership import Membership
from .tiles import TILE

# nodes of the coarser grid within a block, along an axis
_HALF = TILE // 2
# nodes of the coarser grid that a block reads, along an axis
_WINDOW = _HALF + 3
# of a window along an axis, in even and in odd tiles: (number of the block, its nodes, their places in the window)
_PARTS = (
    ((0, slice(0, _WINDOW), slice(0, _WINDOW)),),
    ((0, slice(_HALF, TILE), slice(0, _HALF)), (1, slice(0, _WINDOW - _HALF), slice(_HALF, _WINDOW))),
)
# blocks of a step, which bounds its memory: 2 MiB per channel in float32
_CHUNK = 2048


class Step(NamedTuple):
    """Blocks of one level, all alike in `parity`, no two of a tile: no two have the same parent in the same place.

    So every sum has one owner, and is the same every time: the zeros alone are added to twice, and nothing reads that.
    """

    blocks: Tensor  # [k] int64, numbers of live blocks or of tiles
    parents: Tensor  # [k, 4] int64, live blocks of the next level; their number: zeros
    parity: int  # as in Blocks
    masks: Tensor | None  # [k] int64, rows of masks, where the region is not alone in the tile


class Nodes(NamedTuple):
    """The live blocks of nodes, those that are not all zero, and the steps from them to the pixels."""

    number: Tensor  # [copies, blocks of nodes + 1] int64, of each live block; of others `num_live`
    num_live: int
    refinements: list[Step]  # live blocks, coarsest first
    samples: list[Step]  # tiles of pixels


def find_nodes(blocks: Blocks, membership: Membership | None, touched: Tensor, copies: int) -> Nodes:
    """Find the live blocks from those that Gaussians touch, which are flat positions in Nodes.number.

    Images that share a map have one of the `copies` of its blocks each.
    """
    first, starts = blocks.first, blocks.starts
    parents = blocks.parents - first
    live = torch.zeros(copies, starts[-1] - first + 1, dtype=torch.bool, device=touched.device)
    live.view(-1)[touched] = True
    for low, high in reversed(list(pairwise(starts[1:]))):
        live[:, low - first : high - first] |= live[:, parents[low:high]].any(-1)
    count = int(live.sum())
    number = torch.where(live, live.flatten().cumsum(0).view(live.shape) - 1, count)

    copy, block = live[:, parents].any(-1).nonzero(as_tuple=True)
    pixels, rows, regions = block < first, torch.full_like(block, -1), 1
    last, ends = 4 * len(blocks.grids) - 4, torch.tensor(starts[1:], device=block.device)
    group = last - 4 * torch.bucketize(block, ends, right=True)  # coarsest first
    if membership is not None:
        rows[pixels], regions = membership.tiles(TILE).mask_rows[block[pixels]], membership.num_regions
    tile = copy * blocks.grids[1].first_tile + blocks.keys[block] // regions
    place = torch.where(pixels, tile, number[copy, (block - first).clamp_min(0)])
    # regions that share a tile go one after the other
    pixel_tile = tile[pixels]
    rank = torch.arange(len(pixel_tile), device=block.device) - torch.searchsorted(pixel_tile, pixel_tile) + 1
    group[pixels] += 4 * torch.where(rows[pixels] < 0, 0, rank)
    group += blocks.parity[block]

    order = torch.argsort(group, stable=True)
    refinements: list[Step] = []
    samples: list[Step] = []
    for n, members in enumerate(order.split(torch.bincount(group).tolist())):
        for part in members.split(_CHUNK) if len(members) else ():
            parent = number[copy[part, None], parents[block[part]]]
            step = Step(place[part], parent, n % 4, rows[part] if n >= last + 4 else None)
            (refinements if n < last else samples).append(step)
    return Nodes(number, count, refinements, samples)


def sample(nodes: Tensor, plan: Nodes, masks: Tensor | None, tiles: Tensor) -> None:
    """Refine live blocks in place, (live + 1, C, 16, 16), the last of zeros, and add their splines to the pixels.

    `tiles` are of pixels, (tiles, C, 16, 16). There, splines are multiplied by the membership.
    """
    refinement, sampling = _refinement(nodes.dtype, nodes.device), _sampling(nodes.dtype, nodes.device)
    for step in plan.refinements:
        nodes.index_add_(0, step.blocks, _spread(nodes, step, refinement))
    for step in plan.samples:
        tiles.index_add_(0, step.blocks, _weigh(_spread(nodes, step, sampling), step, masks))


def gather(grad: Tensor, plan: Nodes, masks: Tensor | None) -> Tensor:
    """Turn gradients of tiles, (tiles, C, 16, 16), into those of nodes: the transpose of `sample`."""
    refinement, sampling = _refinement(grad.dtype, grad.device), _sampling(grad.dtype, grad.device)
    nodes = grad.new_zeros(plan.num_live + 1, *grad.shape[1:])
    for step in plan.samples:
        _collect(nodes, step, sampling, _weigh(grad.index_select(0, step.blocks), step, masks))
    for step in reversed(plan.refinements):
        _collect(nodes, step, refinement, nodes.index_select(0, step.blocks))
    return nodes


def _weigh(values: Tensor, step: Step, masks: Tensor | None) -> Tensor:
    if masks is None or step.masks is None:
        return values
    return values.mul_(masks[step.masks].view(-1, 1, TILE, TILE))


def _spread(nodes: Tensor, step: Step, matrix: Tensor) -> Tensor:
    rows = []
    for down, y, _ in _PARTS[step.parity // 2]:
        row = [
            nodes.index_select(0, step.parents[:, 2 * down + right])[..., y, x]
            for right, x, _ in _PARTS[step.parity % 2]
        ]
        rows.append(torch.cat(row, -1))
    return matrix @ (torch.cat(rows, -2) @ matrix.T)


def _collect(nodes: Tensor, step: Step, matrix: Tensor, grad: Tensor) -> None:
    window = matrix.T @ grad @ matrix
    for down, y, top in _PARTS[step.parity // 2]:
        for right, x, left in _PARTS[step.parity % 2]:
            nodes[..., y, x].index_add_(0, step.parents[:, 2 * down + right], window[..., top, left])


@functools.lru_cache(maxsize=4)
def _refinement(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the two-scale relation of cubic B-splines from a window to a block, (16, 11)."""
    weights = {k: math.comb(4, k) / 8 for k in range(5)}
    rows = [[weights.get(p - 2 * n + 3, 0.0) for n in range(_WINDOW)] for p in range(TILE)]
    return torch.tensor(rows, dtype=dtype, device=device)


@functools.lru_cache(maxsize=4)
def _sampling(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return cubic B-splines of a window at the centres of pixels, (16, 11)."""
    rows = [[_spline(abs(p / 2 + 1.25 - n)) for n in range(_WINDOW)] for p in range(TILE)]
    return torch.tensor(rows, dtype=dtype, device=device)


def _spline(distance: float) -> float:
    if distance < 1:
        return 2 / 3 - distance**2 + distance**3 / 2
    return max(2 - distance, 0.0) ** 3 / 6
