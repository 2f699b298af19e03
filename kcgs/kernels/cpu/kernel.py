"""The CPU kernel as torch sees it: tensors become arrays, arrays become lists, and loops run over their rows."""

from __future__ import annotations

import functools
import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcgs.compiled import Workspace, borrowed
from kcgs.compiled.tasks import chunks, phases, run_tasks
from kcgs.maps import MapTable, cached_for, table_at

from ..coarse_grids import make_blocks, max_spacing
from ..grid_columns import TILE_COLS, TILE_ROWS
from ..interface import Gradients, Kernel, SplatInputs
from ..whitened import least_exponent, support_radius
from .gradients import Backward
from .layout import COLUMNS, PAIR_COLUMNS, PREFETCH_DISTANCE, SHAPE_COLUMNS, Batch, Lists, TileTable
from .lists import arrange, list_pairs, measure
from .loops import sum_rows
from .schedule import ADDS, GATHERS, order_tasks
from .simd import SIDE

# least Gaussians per task that lists them, and most tasks
_PART = 128
_MOST_PARTS = 16
# another thread is woken for so many Gaussians to measure, pairs to list, and pairs to visit
_THREAD_GAUSSIANS = 2048
_THREAD_LISTED_PAIRS = 3000
_THREAD_PAIRS = 300


class CpuPlan(NamedTuple):
    """The lists of a render, and the memory that they are in."""

    lists: Lists
    workspace: Workspace  # only the caller's thread holds it: its memory returns when the caller is done


def kernel_for(inputs: SplatInputs) -> Kernel:
    """Return the kernel; raise a ValueError for inputs that it does not take."""
    if inputs.means.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' computes in float32; got {inputs.means.dtype}: use 'tiled' or 'reference'")
    if inputs.means.device.type != "cpu":
        raise ValueError(f"backend 'cpu' needs tensors on the CPU; got {inputs.means.device}")
    return Kernel(
        plan, render, differentiate, error_gradients=error_gradients, checks_values=True, takes_one_image=True
    )


def plan(inputs: SplatInputs) -> CpuPlan | None:
    """List which Gaussians touch which blocks; None where a value is out of range."""
    means, cholesky, colors = (_array(t) for t in inputs.gaussians)
    if inputs.table is not None and inputs.region_positions is not None:
        table = cached_for(table_at(inputs.table, inputs.size), _table_of)
        regions = inputs.region_positions.flatten().numpy()
    else:
        table, regions = _table_without_map(inputs.size), np.empty(0, np.int64)
    batch = Batch(inputs.colors.shape[:-2].numel(), means, cholesky, colors, regions)
    is_valid, order = arrange(batch, *table.grids[0, TILE_ROWS : TILE_COLS + 1].tolist())
    return _list_pairs(batch, table, order, inputs.cutoff) if is_valid else None


def _list_pairs(batch: Batch, table: TileTable, order: Any, cutoff: float) -> CpuPlan:
    radius, least = support_radius(cutoff, torch.float32), least_exponent(cutoff, torch.float32)
    count, blocks = len(order), len(table.parents)
    copies = batch.num_images if table.num_maps == 1 else 1
    workspace = Workspace()
    empty = workspace.empty
    gaussians, spans, counts = empty((count, COLUMNS), np.float64), empty((count, 2), np.int32), empty(count, np.int64)
    colors = empty(batch.colors.size, np.float32)
    parts, measurement, listing = _list_tasks(count)
    spacing = max_spacing(cutoff)
    loop = partial(measure, batch, table, radius, spacing, order, gaussians, colors, spans, counts)
    run_tasks(loop, measurement, count, _THREAD_GAUSSIANS)
    first_terms = empty(count + 1, np.int64)
    first_terms[0] = 0
    np.cumsum(counts, out=first_terms[1:])
    total = int(first_terms[-1])
    lists = Lists(
        order, gaussians, colors, empty(copies * blocks + 1, np.int64),
        empty((total + PREFETCH_DISTANCE, PAIR_COLUMNS), np.int32), empty((total, SHAPE_COLUMNS), np.float32),
        first_terms, empty(count, np.int32), table,
        empty(copies * (blocks - len(table.mask_rows) + 1), np.bool_), np.float32(math.exp(least)),
    )  # fmt: skip
    with workspace.rest() as room:
        histogram, found = room.empty((parts, copies * blocks), np.int32), room.empty((total, 5), np.int32)
        # the phases of one range follow each other: another thread would only wait
        work = min(total, (parts - 1) * _THREAD_LISTED_PAIRS)
        loop = partial(list_pairs, batch, radius, spans, found, histogram, lists)
        run_tasks(loop, listing, work, _THREAD_LISTED_PAIRS)
    return CpuPlan(lists, workspace)


@functools.lru_cache(maxsize=64)
def _list_tasks(count: int) -> tuple[int, Any, Any]:
    """Return the number of ranges of `count` Gaussians, and the tasks of `measure` and `list_pairs`."""
    parts = chunks(count, _PART, _MOST_PARTS)
    return len(parts), phases(parts), phases(parts, np.zeros((1, 2), np.int64), parts)


def _array(tensor: Tensor) -> Any:
    # contiguous, since numba would compile the loops again for every other layout
    return tensor.detach().resolve_neg().reshape(-1, tensor.shape[-1]).contiguous().numpy()


def _table_of(table: MapTable) -> TileTable:
    starts, regions, planes, weights = (part.numpy() for part in table.tiles)
    return _make_table(starts, regions, planes.astype(np.int64), weights.ravel(), table.num_regions, table.shape)


# contour moves render each region alone, at the size of its bounding box: many sizes
@functools.lru_cache(maxsize=256)
def _table_without_map(size: tuple[int, int]) -> TileTable:
    tiles = -(-size[0] // SIDE) * -(-size[1] // SIDE)
    starts, regions = np.arange(tiles + 1), np.zeros(tiles, np.int64)
    return _make_table(starts, regions, np.full(tiles, -1), np.zeros(1, np.float32), 1, (1, *size))


def _make_table(
    starts: Any, regions: Any, planes: Any, masks: Any, num_regions: int, shape: tuple[int, ...]
) -> TileTable:
    grids, tile_start, regions, parents, parity = make_blocks(starts, regions, num_regions, shape)
    return TileTable(num_regions, shape[0], np.array(grids), regions, tile_start, parents, parity, planes, masks)


def render(plan: CpuPlan, inputs: SplatInputs) -> Tensor:
    """Render (B, C, H, W)."""
    *batch, _, channels = inputs.colors.shape
    # numpy asks for huge pages for a large array: its first use takes a quarter of the time of torch.empty's
    image = np.empty((*batch, channels, *inputs.size), np.float32)
    nothing = np.empty((0, 3), np.float32)
    backward = Backward(nothing, nothing, nothing, nothing)
    with plan.workspace.rest() as room:
        nodes = _make_nodes(room, plan.lists, channels)
        _visit(plan.lists, ADDS, backward, image.reshape(-1, *image.shape[-3:]), nodes, nodes[:0], nothing)
    return torch.from_numpy(image)


def differentiate(plan: CpuPlan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    """Return the gradients of means, cholesky (None each without `geometry`) and colors."""
    means, cholesky, colors = _gather(plan, inputs, grad, GATHERS)
    return (means, cholesky, colors) if geometry else (None, None, colors)


def error_gradients(plan: CpuPlan, inputs: SplatInputs, target: Tensor) -> Gradients:
    """Return the gradients of half the squared error, summed over the pixels, against (B, C, H, W)."""
    return _gather(plan, inputs, target, ADDS | GATHERS)


def _gather(plan: CpuPlan, inputs: SplatInputs, image: Tensor, kind: int) -> tuple[Tensor, Tensor, Tensor]:
    lists, channels = plan.lists, inputs.colors.shape[-1]
    means, cholesky, colors = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs.gaussians)
    gradients = (t.view(-1, t.shape[-1]).numpy() for t in (means, cholesky, colors))
    backward = Backward(_array(inputs.cholesky), *gradients)
    with plan.workspace.rest() as room:
        if image.is_neg() or not image.is_contiguous():
            image = torch.from_numpy(room.empty(tuple(image.shape), np.float32)).copy_(image)
        # the loops sum eight terms at a time
        terms = room.empty((len(lists.pairs), -(-(channels + 5) // 8) * 8), np.float32)
        slopes = _make_nodes(room, lists, channels)
        nodes = _make_nodes(room, lists, channels) if kind & ADDS else slopes[:0]
        _visit(lists, kind, backward, image.numpy().reshape(-1, *image.shape[-3:]), nodes, slopes, terms)
    return means, cholesky, colors


def _make_nodes(room: Workspace, lists: Lists, channels: int) -> Any:
    return room.empty(len(lists.live) * SIDE * SIDE * channels if lists.live.any() else 0, np.float32)


def _visit(lists: Lists, kind: int, backward: Backward, image: Any, nodes: Any, slopes: Any, terms: Any) -> None:
    counts = tuple(lists.table.grids[: None if lists.live.any() else 1, TILE_ROWS].tolist())
    tasks = order_tasks(counts, len(image), kind, len(lists.live), len(lists.order))
    loop = partial(sum_rows, lists, backward, borrowed(image), nodes, slopes, terms)
    run_tasks(loop, tasks, len(lists.pairs), _THREAD_PAIRS)
