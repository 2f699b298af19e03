"""The CPU kernel as torch sees it: tensors become arrays, arrays become lists, and loops run over their rows."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..coarse_grids import blocks_of, max_spacing
from ..interface import Gradients, SplatInputs, Steps
from ..membership import Membership
from ..whitened import least_exponent, support_radius
from .gradients import GaussianGradients, sum_terms
from .layout import TILE_ROWS, Batch, Lists, Table
from .lists import in_range, list_tiles
from .loops import gather_gradients
from .loops import render as render_rows
from .schedule import Schedule, order_rows, run
from .simd import SIDE


class _Plan(NamedTuple):
    lists: Lists
    order: Any  # [N] int64, from the lists' order to the caller's
    has_nodes: bool
    schedule: Schedule


def steps(inputs: SplatInputs) -> Steps:
    """Return the kernel, if it takes these inputs."""
    if inputs.means.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' computes in float32; got {inputs.means.dtype}: use 'tiled' or 'reference'")
    if inputs.means.device.type != "cpu":
        raise ValueError(f"backend 'cpu' needs tensors on the CPU; got {inputs.means.device}")
    return Steps(plan, render, differentiate, checks_inputs=True)


def plan(inputs: SplatInputs) -> _Plan | None:
    """List which Gaussians touch which tiles, for the loops; None where a value is out of range."""
    num_images, count = inputs.colors.shape[:-2].numel(), inputs.colors.shape[-2]
    means, cholesky, colors = (_array(t) for t in inputs.gaussians)
    if not in_range(means, cholesky, colors):
        return None
    images = np.repeat(np.arange(num_images), count)
    order = _sort(means, images, inputs.size)
    if inputs.membership is not None and inputs.region_index is not None:
        table = inputs.membership.derived("cpu", lambda m: _table(m, inputs.size))
        regions = inputs.region_index.flatten().numpy()[order]
    else:
        table, regions = _table_without_map(inputs.size), np.zeros(num_images * count, np.int64)
    radius = support_radius(inputs.cutoff, torch.float32)
    least = np.float32(least_exponent(inputs.cutoff, torch.float32) / math.log(2))
    batch = Batch(num_images, means, cholesky, order, images[order], regions, colors[order])
    gaussians, start, entries, live = list_tiles(batch, table, radius, max_spacing(inputs.cutoff))
    lists = Lists(gaussians, batch.colors.ravel(), regions, start, entries, table, live, radius, least)
    return _Plan(lists, order, live.any(), order_rows(tuple(table.grids[:, TILE_ROWS].tolist()), num_images))


def _array(tensor: Tensor) -> Any:
    # contiguous, since every other layout would be compiled for
    return tensor.detach().resolve_neg().reshape(-1, tensor.shape[-1]).contiguous().numpy()


def _sort(means: Any, images: Any, size: tuple[int, int]) -> Any:
    """Order by image, row and column of tiles: neighbours in the image become neighbours in memory."""
    rows, cols = (-(-side // SIDE) + 2 for side in size)
    row, col = (np.clip(means[:, k] * (1 / SIDE) + 1, 0, n - 1).astype(np.int64) for k, n in ((1, rows), (0, cols)))
    tile = (images * rows + row) * cols + col
    # numbers of 16 bits are sorted in linear time; stable, so that the order of two does not depend on others
    return np.argsort(tile.astype(np.uint16) if tile.size and tile.max() < 1 << 16 else tile, kind="stable")


# contour moves render each region alone, in the size of its box
@functools.lru_cache(maxsize=256)
def _table_without_map(size: tuple[int, int]) -> Table:
    return _table(None, size)


def _table(membership: Membership | None, size: tuple[int, int]) -> Table:
    blocks = blocks_of(membership, size, torch.device("cpu"))
    keys, num_regions, num_maps = blocks.keys.numpy(), 1, 1
    mask_rows, masks = np.full(blocks.first, -1), np.zeros(1, np.float32)
    if membership is not None:
        num_regions, num_maps = membership.num_regions, len(membership.index)
        tiles = membership.tiles(SIDE)
        mask_rows, masks = tiles.mask_rows.numpy(), tiles.masks.to(torch.float32).flatten().numpy()
    finest, coarsest = blocks.grids[0], blocks.grids[-1]
    num_tiles = coarsest.first_tile + num_maps * coarsest.rows * coarsest.cols
    tile_start = np.searchsorted(keys, np.arange(num_tiles + 1) * num_regions)
    first_rows = np.cumsum([0, *(grid.rows for grid in blocks.grids[:-1])])
    grids = np.column_stack([np.array(blocks.grids), first_rows])
    regions, parents, parity = keys % num_regions, blocks.parents.numpy(), blocks.parity.numpy()
    unmixed = np.flatnonzero(mask_rows < 0)
    owner = np.full(num_maps * finest.rows * finest.cols, -1)
    owner[keys[unmixed] // num_regions] = regions[unmixed]
    return Table(num_regions, num_maps, grids, regions, tile_start, parents, parity, owner, mask_rows, masks)


def render(planned: _Plan, inputs: SplatInputs) -> Tensor:
    """Render (B, C, H, W)."""
    *batch, _, channels = inputs.colors.shape
    # numpy asks for huge pages where an array is large: first use costs a quarter of what torch.empty's does
    image = np.empty((*batch, channels, *inputs.size), np.float32)
    images, nodes = image.reshape(-1, *image.shape[-3:]), _make_nodes(planned, channels)
    _run(lambda rows: render_rows(planned.lists, rows, images, nodes), planned, reverse=True)
    return torch.from_numpy(image)


def differentiate(planned: _Plan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    """Return the gradients of means, cholesky (None each without `geometry`) and colors."""
    channels = inputs.colors.shape[-1]
    # the loops sum eight terms at a time
    terms = np.empty((len(planned.lists.entries), -(-(channels + 5 * geometry) // 8) * 8), np.float32)
    values = grad.resolve_neg().contiguous().numpy().reshape(-1, *grad.shape[-3:])
    nodes = _make_nodes(planned, channels)
    _run(lambda rows: gather_gradients(planned.lists, rows, values, terms, geometry, nodes), planned, reverse=False)
    means, cholesky, colors = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs.gaussians)
    gradients = GaussianGradients(*(t.view(-1, t.shape[-1]).numpy() for t in (means, cholesky, colors)))
    sum_terms(planned.lists, planned.order, _array(inputs.cholesky), terms, geometry, gradients)
    return (means, cholesky, colors) if geometry else (None, None, colors)


def _make_nodes(planned: _Plan, channels: int) -> Any:
    return np.zeros(len(planned.lists.live) * SIDE * SIDE * channels if planned.has_nodes else 0, np.float32)


def _run(visit: Any, planned: _Plan, reverse: bool) -> None:
    run(visit, planned.schedule, len(planned.lists.entries), planned.has_nodes, reverse)
