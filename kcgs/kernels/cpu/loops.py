"""The loops of the CPU kernel over rows of tiles, forward and backward: `render` and `gather`.

A row of tiles belongs to one thread, so the result does not depend on the number of threads. Within a tile only the
rows of pixels that the ellipse crosses are visited. Wide Gaussians are evaluated in blocks of nodes of coarser grids,
which are refined from level to level and sampled at the pixels.

Pixels of a row of tiles lie in one array as [SIDE rows][channel][PADDING + columns + PADDING]; blocks of nodes lie one
after the other as [SIDE rows][channel][SIDE columns].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled import inner
from .ellipse import enter_rows, enter_tile
from .layout import END, FIRST, GAUSSIAN, NODE_COLS, NODE_ROWS, PADDING, TILE_COLS, program
from .lists import find_block, first_node_block, first_tile
from .rows import add_rows, add_sheared, gather_rows, gather_sheared
from .schedule import REFINEMENT
from .simd import SIDE, clear_rows, copy, sum_columns
from .spline import add_refined, add_sampled, gather_refined, gather_sampled, set_sampled


@program.entry
def render(lists, rows, image, nodes):  # type: ignore[no-untyped-def]
    """Render rows of tiles into nodes and into the image, one after the other.

    Args:
        lists: Lists.
        rows: (R, 4) int64, see schedule.Schedule.
        image: (B, C, H, W) float32, of which each row of pixels fills its part.
        nodes: float32, the live blocks of all coarse grids, from zero; empty where no Gaussian is wide.
    """
    channels, stride = image.shape[1], _row_stride(image)
    pixels, shape = np.empty(SIDE * channels * stride, np.float32), np.empty(9)
    for k in range(len(rows)):
        _, level, b, row = rows[k]
        if level == REFINEMENT:
            _refine(lists, nodes, channels, False)
            continue
        if level == 0 and len(nodes) > 0:
            _sample_row(lists, b, row, pixels, nodes, channels, False)
        elif level == 0:
            for i in range(len(pixels)):
                pixels[i] = 0.0
        values, step = (nodes, SIDE) if level > 0 else (pixels, stride)
        _add_row(lists, rows[k], values, step, channels, shape, None, None, False)
        if level == 0:
            _copy_row(pixels, image, b, row, True)


@program.entry
def gather_gradients(lists, rows, grad, terms, geometry, nodes):  # type: ignore[no-untyped-def]
    """Sum the gradients of the entries of rows of tiles, and those of nodes.

    Args:
        lists: Lists.
        rows: (R, 4) int64, see schedule.Schedule.
        grad: (B, C, H, W) float32, of the image.
        terms: (E, C + 5 or C, rounded up to a multiple of 8) float32, of which each entry's is set: w g of each
            channel, then v (z1, z2, z1 z1, z1 z2, z2 z2) with z times SCALE, see whitened.sums_to_gradients.
        geometry: whether to sum the latter five, too.
        nodes: float32, as in `render`; becomes the gradients of the nodes.
    """
    channels, stride = grad.shape[1], _row_stride(grad)
    pixels, shape = np.zeros(SIDE * channels * stride, np.float32), np.empty(9)
    sums = np.zeros(terms.shape[1] * SIDE, np.float32)
    for k in range(len(rows)):
        number, level, b, row = rows[k]
        if level == REFINEMENT:
            _refine(lists, nodes, channels, True)
            continue
        if level == 0 and len(nodes) == 0 and lists.start[number] == lists.start[number + 1]:
            continue
        if level == 0:
            _copy_row(pixels, grad, b, row, False)
        if level == 0 and len(nodes) > 0:
            _sample_row(lists, b, row, pixels, nodes, channels, True)
        values, step = (nodes, SIDE) if level > 0 else (pixels, stride)
        _gather_row(lists, rows[k], values, step, channels, shape, sums, terms, geometry)


@inner
def _row_stride(image):  # type: ignore[no-untyped-def]
    """Return the elements from a channel of a row of pixels to the next."""
    return -(-image.shape[3] // SIDE) * SIDE + 2 * PADDING


@inner
def _copy_row(pixels, image, b, row, outward):  # type: ignore[no-untyped-def]
    """Copy the pixels of a row of tiles to an image, or from there; outside of the image they are zero."""
    channels, height, width = image.shape[1:]
    stride, top = _row_stride(image), row * SIDE
    for r in range(min(SIDE, height - top)):
        for c in range(channels):
            outside, inside = ((b * channels + c) * height + top + r) * width, (r * channels + c) * stride + PADDING
            if outward:
                copy(image, outside, pixels, inside, width)  # type: ignore[call-arg]
            else:
                copy(pixels, inside, image, outside, width)  # type: ignore[call-arg]
    if not outward:
        for k in range((height - top) * channels * stride, len(pixels)):
            pixels[k] = 0.0


@inner
def _refine(lists, nodes, channels, transposed):  # type: ignore[no-untyped-def]
    """Add the splines of coarser blocks to every block of nodes; or, transposed, its gradients to the coarser ones."""
    table, live, stride = lists.table, lists.live, SIDE * channels
    parents, parity, offsets, ones = table.parents, table.parity, np.empty(4, np.int64), np.ones(SIDE, np.float32)
    first, count = len(table.mask_rows), len(parents) - len(table.mask_rows)
    for base in range(-first, len(live) - first, count + 1):
        for n in range(count):
            block = first + (n if transposed else count - 1 - n)
            if not _set_offsets(live, parents, block, base, SIDE * stride, offsets):
                continue
            start, down, right = (base + block) * SIDE * stride, parity[block] >= 2, parity[block] % 2 == 1
            if transposed:
                gather_refined(nodes, offsets, down, right, nodes, start, stride, SIDE, channels, ones, 0, 0)
            else:
                add_refined(nodes, offsets, down, right, nodes, start, stride, SIDE, channels, ones, 0, 0)


@inner
def _sample_row(lists, image, row, pixels, nodes, channels, transposed):  # type: ignore[no-untyped-def]
    """Set a row of tiles to the nodes' splines times the membership; or, transposed, add its gradients to the nodes."""
    table, live, stride = lists.table, lists.live, len(pixels) // (SIDE * channels)
    tile_start, parents, mask_rows, masks = table.tile_start, table.parents, table.mask_rows, table.masks
    offsets, ones, down = np.empty(4, np.int64), np.ones(SIDE, np.float32), row % 2 == 1
    across = channels * stride  # elements from a row of pixels to the next
    base, tile = first_node_block(table, image) - len(mask_rows), first_tile(table, 0, image, row)
    for col in range(table.grids[0, TILE_COLS]):
        start, right, empty = PADDING + col * SIDE, col % 2 == 1, True
        for block in range(tile_start[tile + col], tile_start[tile + col + 1]):
            if not _set_offsets(live, parents, block, base, SIDE * SIDE * channels, offsets):
                continue
            weights, mask_start, step = ones, 0, 0
            if mask_rows[block] >= 0:
                weights, mask_start, step = masks, mask_rows[block] * SIDE * SIDE, SIDE
            if transposed:
                gather_sampled(
                    nodes, offsets, down, right, pixels, start, across, stride, channels, weights, mask_start, step
                )
            elif empty:
                set_sampled(
                    nodes, offsets, down, right, pixels, start, across, stride, channels, weights, mask_start, step
                )
            else:
                add_sampled(
                    nodes, offsets, down, right, pixels, start, across, stride, channels, weights, mask_start, step
                )
            empty = False
        if empty and not transposed:
            clear_rows(pixels, start, stride, SIDE * channels)  # type: ignore[call-arg]


@inner
def _set_offsets(live, parents, block, base, size, offsets):  # type: ignore[no-untyped-def]
    """Set the offsets of a block's parents, of `size` elements each; return whether one is live."""
    is_live = False
    for k in range(4):
        parent = base + parents[block, k]
        if live[parent]:
            is_live = True
        else:
            parent = base + len(parents)  # the block of zeros
        offsets[k] = parent * size
    return is_live


def _make_row_loop(gathers: bool) -> Any:
    """Make the loop over the Gaussians of a row of tiles, which adds them to pixels, or gathers their gradients."""

    @inner
    def visit_row(lists, place, pixels, stride, channels, shape, sums, terms, geometry):  # type: ignore[no-untyped-def]
        """Visit a row of Schedule, whose `pixels` are those of its tiles, or the blocks of all nodes.

        `shape` (9,) float64 and `sums` (as many as terms, times SIDE) float32 are room.
        """
        number, level, image, row = place
        block_size, across = SIDE * SIDE * channels, channels * stride
        table, gaussians, entries, colors = lists.table, lists.gaussians, lists.entries, lists.colors
        num_regions, regions = table.num_regions, table.regions
        tile_start, mask_rows = table.tile_start, table.mask_rows
        height, width = table.grids[level, NODE_ROWS], table.grids[level, NODE_COLS]
        tile, first_block = first_tile(table, level, image, row), first_node_block(table, image) - len(mask_rows)
        masks, radius, least = table.masks, lists.radius, lists.least_exponent
        for e in range(lists.start[number], lists.start[number + 1]):
            i, start, end = entries[e, GAUSSIAN], entries[e, FIRST], entries[e, END]
            region = lists.regions[i]
            if gathers:
                for k in range(len(sums)):
                    sums[k] = 0.0
            if start < 0:
                first, last = enter_rows(gaussians[i], row, height, width, radius, end, shape)
                if gathers:
                    gather_sheared(  # type: ignore[call-arg]
                        pixels, PADDING, across, stride, channels, first, last, shape, colors, i * channels, least,
                        end, sums, geometry,
                    )  # fmt: skip
                else:
                    add_sheared(  # type: ignore[call-arg]
                        pixels, PADDING, across, stride, channels, first, last, shape, colors, i * channels, least, end
                    )
                start = end  # it is on no list of tiles
            for col in range(start, end):
                block = find_block(num_regions, tile_start, regions, tile + col, region)
                if block < 0:
                    continue
                first, last = enter_tile(gaussians[i], row, col, height, width, radius, shape)
                if first >= last:
                    continue
                origin, mask_start = (first_block + block) * block_size, -1
                if level == 0:
                    origin, mask_start = PADDING + col * SIDE, mask_rows[block] * SIDE * SIDE
                if gathers:
                    gather_rows(  # type: ignore[call-arg]
                        pixels, origin, across, stride, channels, first, last, shape, colors, i * channels, least,
                        masks, mask_start, sums, geometry,
                    )  # fmt: skip
                else:
                    add_rows(  # type: ignore[call-arg]
                        pixels, origin, across, stride, channels, first, last, shape, colors, i * channels, least,
                        masks, mask_start,
                    )  # fmt: skip
            if gathers:
                sum_columns(sums, terms.shape[1], terms, e * terms.shape[1])  # type: ignore[call-arg]

    return visit_row


_add_row = _make_row_loop(False)
_gather_row = _make_row_loop(True)
