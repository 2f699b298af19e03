"""The CPU kernel as torch sees it: what the loops read, how threads share them, what they return.

The first call compiles, once for each machine and user, or loads the compiled code.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..coarse_grids import blocks_of, most_spacing
from ..interface import Gradients, OutOfRangeError, SplatInputs, Steps
from ..membership import Membership
from ..threads import num_threads
from ..whitened import least_exponent, support_radius
from . import loops
from .lists import ROWS, Lists, Table, in_range, list_tiles, order_rows
from .simd import SIDE

# fewer entries of the lists than this are left to the calling thread: waking another costs as much
_SERIAL_ENTRIES = 200


class _Plan(NamedTuple):
    lists: Lists
    order: Any  # [N] int64, sorted to given
    has_nodes: bool
    rows: Any  # see order_rows
    starts: list[int]


def steps(inputs: SplatInputs) -> Steps:
    """Return the kernel, if it takes these inputs."""
    if inputs.means.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' computes in float32; got {inputs.means.dtype}: use 'tiled' or 'reference'")
    if inputs.means.device.type != "cpu":
        raise ValueError(f"backend 'cpu' needs tensors on the CPU; got {inputs.means.device}")
    return _STEPS


def plan(inputs: SplatInputs) -> _Plan:
    """List which Gaussians touch which tiles, for the loops."""
    batch, count = inputs.colors.shape[:-2].numel(), inputs.colors.shape[-2]
    height, width = inputs.size
    means, factors, colors = (_array(t) for t in inputs[:3])
    if not in_range(means, factors, colors):
        raise OutOfRangeError
    images = np.repeat(np.arange(batch), count)
    order = _sort(means, images, height, width)
    images, colors = images[order], colors[order]
    if inputs.membership is not None and inputs.region_index is not None:
        table = inputs.membership.derived("cpu", lambda m: _table(m, inputs.size))
        regions = inputs.region_index.flatten().numpy()[order]
    else:
        table, regions = _table_without_map(inputs.size), np.zeros(batch * count, np.int64)
    radius = support_radius(inputs.cutoff, torch.float32)
    lowest = np.float32(least_exponent(inputs.cutoff, torch.float32) / math.log(2))
    gaussians, start, entries, live = list_tiles(
        means, factors, colors, order, regions, images, batch, table, radius, most_spacing(inputs.cutoff)
    )
    lists = Lists(gaussians, colors.ravel(), regions, start, entries, table, live, radius, lowest)
    return _Plan(lists, order, live.any(), *order_rows(tuple(table.grids[:, ROWS].tolist()), batch))


def _sort(means: Any, images: Any, height: int, width: int) -> Any:
    """Order by image, row and column of tiles: neighbours in the image become neighbours in memory."""
    rows, cols = -(-height // SIDE) + 2, -(-width // SIDE) + 2
    row, col = (np.clip(means[:, k] * (1 / SIDE) + 1, 0, n - 1).astype(np.int64) for k, n in ((1, rows), (0, cols)))
    tile = (images * rows + row) * cols + col
    # numbers of 16 bits are sorted in linear time; stable: what other Gaussians do must not change the order of these
    return np.argsort(tile.astype(np.uint16) if tile.size and tile.max() < 1 << 16 else tile, kind="stable")


def _array(tensor: Tensor) -> Any:
    # contiguous, since every other layout would be compiled for
    return tensor.detach().resolve_neg().reshape(-1, tensor.shape[-1]).contiguous().numpy()


@functools.lru_cache(maxsize=4)
def _table_without_map(size: tuple[int, int]) -> Table:
    return _table(None, size)


def _table(membership: Membership | None, size: tuple[int, int]) -> Table:
    blocks = blocks_of(membership, size, torch.device("cpu"))
    keys, (regions, maps) = blocks.keys.numpy(), (1, 1)
    mask, masks = np.full(blocks.first, -1), np.zeros(1, np.float32)
    if membership is not None:
        regions, maps = membership.num_regions, len(membership.index)
        tiles = membership.tiles(SIDE)
        mask, masks = tiles.mask.numpy(), tiles.masks.to(torch.float32).flatten().numpy()
    last = blocks.grids[-1]
    start = np.searchsorted(keys, np.arange(last.first_tile + maps * last.rows * last.cols + 1) * regions)
    rows = np.cumsum([0, *(grid.rows for grid in blocks.grids[:-1])])
    grids = np.column_stack([np.array(blocks.grids), rows])
    of_block, parents, odd = keys % regions, blocks.parents.numpy(), blocks.odd.numpy()
    whole = np.flatnonzero(mask < 0)
    owner = np.full(maps * blocks.grids[0].rows * blocks.grids[0].cols, -1)
    owner[keys[whole] // regions] = of_block[whole]
    return Table(regions, maps, grids, of_block, start, parents, odd, owner, mask, masks)


def render(planned: _Plan, inputs: SplatInputs) -> Tensor:
    """Render (B, C, H, W)."""
    *batch, _, channels = inputs.colors.shape
    # numpy asks for huge pages where an array is large: first use costs a quarter of what torch.empty's does
    image = np.empty((*batch, channels, *inputs.size), np.float32)
    images, nodes = image.reshape(-1, *image.shape[-3:]), _make_nodes(planned, channels)
    _run_threads(lambda rows: loops.render(planned.lists, rows, images, nodes), planned, reverse=True)
    return torch.from_numpy(image)


def differentiate(planned: _Plan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    """Give the gradients of means, cholesky (unless only colours are asked for) and colors."""
    channels = inputs.colors.shape[-1]
    # the loops sum eight terms at a time
    terms = np.empty((len(planned.lists.entries), -(-(channels + 5 * geometry) // 8) * 8), np.float32)
    values = grad.resolve_neg().contiguous().numpy().reshape(-1, *grad.shape[-3:])
    nodes = _make_nodes(planned, channels)
    _run_threads(lambda rows: loops.gather(planned.lists, rows, values, terms, geometry, nodes), planned)
    means, cholesky, colors = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs[:3])
    flat = [t.view(-1, t.shape[-1]).numpy() for t in (means, cholesky, colors)]
    loops.finish(planned.lists, planned.order, _array(inputs.cholesky), terms, geometry, *flat)
    return (means, cholesky, colors) if geometry else (None, None, colors)


_STEPS = Steps(plan, render, differentiate, as_given=True)


def _make_nodes(planned: _Plan, channels: int) -> Any:
    return np.zeros(len(planned.lists.live) * SIDE * SIDE * channels if planned.has_nodes else 0, np.float32)


@functools.cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    # by process, since threads do not survive a fork
    return ThreadPoolExecutor(threads, thread_name_prefix="kcgs")


def _run_threads(work: Callable[[Any], None], planned: _Plan, reverse: bool = False) -> None:
    """Run work(rows of tiles) with torch's number of threads, the caller's among them, section by section."""
    starts = planned.starts if planned.has_nodes else planned.starts[:4]
    rows = planned.rows[: starts[-1]]
    threads = min(num_threads(), len(rows))
    if threads < 2 or len(planned.lists.entries) < _SERIAL_ENTRIES:
        work(rows[::-1].copy() if reverse else rows)
        return
    sections = [rows[first:last] for first, last in itertools.pairwise(starts)] if planned.has_nodes else [rows]
    for section in reversed(sections) if reverse else sections:
        parts = [section[t::threads].copy() for t in range(min(threads, len(section)))]
        others = [_pool(os.getpid(), num_threads() - 1).submit(work, part) for part in parts[1:]]
        for part in parts[:1]:
            work(part)
        for other in others:
            other.result()
