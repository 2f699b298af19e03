"""The loops of the CPU kernel over rows of blocks: forward, backward, or both at once against a target.

A block, 16 x 16 pixels or nodes of a coarse grid, stays in the processor's cache while all of its Gaussians are added
or gathered. Within it only the rows that the ellipse crosses are visited. Wide Gaussians are evaluated in blocks of
nodes, which are refined from level to level and sampled at the pixels. A row of blocks is one task, and every sum has a
fixed order, so the result does not depend on the number of threads. A block lies in memory as
[SIDE rows][channel][SIDE columns].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kcgs.compiled.program import inline_once, inner
from kcgs.compiled.tasks import first_task, next_task

from ..grid_columns import TILE_COLS
from .gradients import sum_terms
from .layout import program
from .lists import first_head, first_node_block, first_tile
from .rows import add_rows, gather_rows
from .schedule import ADDS, CLEARS, FIRST_FIELD, GATHERS, IMAGE, KIND, LEVEL_FIELD, ROW, SUMS
from .simd import HALF, SIDE, exchange_rows
from .spline import add_refined, add_sampled, gather_refined, gather_sampled


@program.entry
def sum_rows(lists, backward, image, nodes, slopes, terms, tasks, counters):
    """Add or gather rows of blocks, and sum up the terms of Gaussians.

    Args:
        lists: Lists.
        backward: gradients.Backward; empty where tasks only add.
        image: (B, C, H, W) float32. Tasks that only add write it; tasks that only gather read it as the gradient; for
            tasks that do both it is the target, and the gradient is the sum of the Gaussians minus the target.
        nodes: float32, room for the blocks of all coarse grids; empty where no Gaussian is wide.
        slopes: float32, room for the gradients of the nodes; empty where no Gaussian is wide, or where tasks only add.
        terms: (P, C + 5, rounded up to a multiple of 8) float32, a row per pair, which is set: w g of each channel,
            then v (z1, z2, z1 z1, z1 z2, z2 z2) with z times SCALE, see whitened.sums_to_gradients.
        tasks: see schedule.py.
        counters: see tasks.py.
    """
    channels = image.shape[1]
    # a vector that begins at a multiple of its size lies in one line of the cache
    room = np.zeros(SIDE * SIDE * channels + SIDE, np.float32)
    pixels = room[-(room.ctypes.data // 4) % SIDE :]
    sums = np.zeros(max(terms.shape[1], 8) * HALF, np.float32)
    offsets, ones = np.empty(4, np.int64), np.ones(SIDE, np.float32)
    k = first_task(tasks, counters)
    while k >= 0:
        first, end = tasks[k, FIRST_FIELD], tasks[k, FIRST_FIELD + 1]
        if tasks[k, KIND] == SUMS:
            sum_terms(lists, backward, terms, first, end)
        elif tasks[k, KIND] == CLEARS:
            for grid in (nodes, slopes):
                _clear(lists, grid, SIDE * SIDE * channels, first, end)
        else:
            _visit_row(lists, tasks[k], image, pixels, nodes, slopes, terms, sums, offsets, ones)
        k = next_task(tasks, counters, k)


@inner
def _clear(lists, grid, size, first, end):
    """Set the live blocks of nodes to zero, and the last block of each copy, which stands for blocks not live."""
    copy = len(lists.table.parents) - len(lists.table.mask_rows) + 1
    for block in range(first, end if len(grid) > 0 else first):
        if lists.live[block] or (block + 1) % copy == 0:
            grid[block * size : (block + 1) * size] = 0.0


@inline_once
def _visit_row(lists, task, image, pixels, nodes, slopes, terms, sums, offsets, ones):
    """Visit a row of blocks: add, gather, or both."""
    table, live, start, pairs = lists.table, lists.live, lists.start, lists.pairs
    tile_start, parents, parity = table.tile_start, table.parents, table.parity
    mask_rows, masks, shapes = table.mask_rows, table.masks, lists.shapes.ravel()
    level, b, row = task[LEVEL_FIELD], task[IMAGE], task[ROW]
    adds, gathers = (task[KIND] & ADDS) != 0, (task[KIND] & GATHERS) != 0
    channels = image.shape[1]
    size = SIDE * SIDE * channels
    tile, base = first_tile(table, level, b, row), first_node_block(table, b) - len(mask_rows)
    head = first_head(table, b)
    values, gradients = (nodes, slopes) if level > 0 else (pixels, pixels)
    for col in range(table.grids[level, TILE_COLS]):
        first_block, end_block = tile_start[tile + col], tile_start[tile + col + 1]
        if adds and level == 0:
            pixels[:size] = 0.0
        for block in range(first_block, end_block if adds else first_block):
            origin = (base + block) * size if level > 0 else 0
            weights, first, step = _mask(mask_rows, masks, ones, block, level)
            mask = first if step > 0 else -1
            if len(nodes) > 0 and _set_offsets(live, parents, block, base, size, offsets):
                _add_spline(nodes, offsets, parity[block], level, values, origin, channels, weights, first, step)
            for v in range(start[head + block], start[head + block + 1]):
                add_rows(  # type: ignore[call-arg]
                    values, origin, channels, pairs, v, shapes, lists.colors, lists.cutoff, masks, mask
                )
        if level == 0:
            _exchange(image, pixels, b, row * SIDE, col * SIDE, adds, gathers)
        for block in range(first_block, end_block if gathers else first_block):
            origin = (base + block) * size if level > 0 else 0
            weights, first, step = _mask(mask_rows, masks, ones, block, level)
            mask = first if step > 0 else -1
            for v in range(start[head + block], start[head + block + 1]):
                gather_rows(  # type: ignore[call-arg]
                    gradients, origin, channels, pairs, v, shapes, lists.colors, lists.cutoff, masks, mask, sums,
                    terms, terms.shape[1],
                )  # fmt: skip
            if len(slopes) > 0 and _set_offsets(live, parents, block, base, size, offsets):
                _gather_spline(slopes, offsets, parity[block], level, gradients, origin, channels, weights, first, step)


def _make_spline(refine: Any, sample: Any) -> Any:
    """Make the loop between a block and its parents: `refine` for blocks of nodes, `sample` for blocks of pixels."""

    @inner
    def visit_spline(coarse, offsets, parity, level, fine, origin, channels, weights, first, step):
        down, right, across = parity >= 2, parity % 2 == 1, SIDE * channels
        if level > 0:
            refine(coarse, offsets, down, right, fine, origin, across, SIDE, channels, weights, first, step)
        else:
            sample(coarse, offsets, down, right, fine, origin, across, SIDE, channels, weights, first, step)

    return visit_spline


_add_spline = _make_spline(add_refined, add_sampled)
_gather_spline = _make_spline(gather_refined, gather_sampled)


@inner
def _exchange(image, pixels, b, top, left, adds, gathers):
    """Copy a block to an image (adds) or from it (gathers), or subtract the image (both); outside it is zero."""
    channels, height, width = image.shape[1:]
    rows, cols = min(SIDE, height - top), min(SIDE, width - left)
    if gathers and (rows < SIDE or cols < SIDE):
        for r in range(SIDE):
            for k in range((cols if r < rows else 0), SIDE):
                for c in range(channels):
                    pixels[(r * channels + c) * SIDE + k] = 0.0
    exchange_rows(  # type: ignore[call-arg]
        image, (b * channels * height + top) * width + left, width, height * width, pixels, channels, rows, cols, adds,
        gathers,
    )  # fmt: skip


@inner
def _mask(mask_rows, masks, ones, block, level):
    """Return the membership of a block's pixels: array, first element, and step between rows; step 0: all are 1."""
    if level > 0 or mask_rows[block] < 0:
        return ones, 0, 0
    return masks, mask_rows[block] * SIDE * SIDE, SIDE


@inner
def _set_offsets(live, parents, block, base, size, offsets):
    """Set the offsets of a block's parents, of `size` elements each; return whether any parent is live."""
    is_live = False
    for k in range(4):
        parent = base + parents[block, k]
        if live[parent]:
            is_live = True
        else:
            parent = base + len(parents)  # the block of zeros
        offsets[k] = parent * size
    return is_live
