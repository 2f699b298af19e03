"""The loops of the CPU kernel: over rows of tiles, the Gaussians of each, and the tiles that each touches.

A row of tiles belongs to one thread, so the result does not depend on the number of threads. Within a tile only the
rows of pixels that the ellipse crosses are visited. Wide Gaussians are evaluated in blocks of nodes of coarser grids,
which are refined from level to level and brought to the pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled import inner
from .lists import (
    COLS,
    COLS_OF_NODES,
    FACTOR,
    L11,
    L21,
    L22,
    LEVEL,
    PADDING,
    REFINEMENT,
    ROWS_OF_NODES,
    SCALE,
    copy_of,
    enter_rows,
    enter_tile,
    find_block,
    first_tile,
    program,
)
from .rows import add_rows, add_sheared, gather_rows, gather_sheared
from .simd import SIDE, clear_rows, copy, sum_columns
from .spline import add_refined, add_sampled, gather_refined, gather_sampled, set_sampled


@inner
def _exchange(pixels, stride, image, b, row, outward):  # type: ignore[no-untyped-def]
    """Copy a row of tiles to its place in an image, or from there."""
    channels, height, width = image.shape[1:]
    top = row * SIDE
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
def _find_parents(live, parents, block, base, per_tile, offsets):  # type: ignore[no-untyped-def]
    """Set the offsets of the blocks that one is refined from; say whether any is not all zero."""
    found = False
    for k in range(4):
        parent = base + parents[block, k]
        if live[parent]:
            found = True
        else:
            parent = base + len(parents)  # the block of zeros
        offsets[k] = parent * per_tile
    return found


@inner
def _refine(lists, nodes, channels, transposed):  # type: ignore[no-untyped-def]
    """Add to every block of nodes what the coarser ones say of it; or, from the finest on, to them what it says."""
    table, live, stride = lists.table, lists.live, SIDE * channels
    parents, odd, offsets, one = table.parents, table.odd, np.empty(4, np.int64), np.ones(SIDE, np.float32)
    first, count = len(table.mask), len(parents) - len(table.mask)
    for base in range(-first, len(live) - first, count + 1):
        for n in range(count):
            block = first + (n if transposed else count - 1 - n)
            if not _find_parents(live, parents, block, base, SIDE * stride, offsets):
                continue
            at, down, right = (base + block) * SIDE * stride, odd[block] >= 2, odd[block] % 2 == 1
            if transposed:
                gather_refined(nodes, offsets, down, right, nodes, at, stride, SIDE, channels, one, 0, 0)
            else:
                add_refined(nodes, offsets, down, right, nodes, at, stride, SIDE, channels, one, 0, 0)


@inner
def _sample_row(lists, image, row, pixels, stride, nodes, channels, transposed):  # type: ignore[no-untyped-def]
    """Set a row of tiles to the nodes' splines times the region weights; or add its gradients to the nodes."""
    table, live, rows = lists.table, lists.live, channels * stride
    tile_start, parents, mask, masks = table.tile_start, table.parents, table.mask, table.masks
    offsets, one, down = np.empty(4, np.int64), np.ones(SIDE, np.float32), row % 2 == 1
    base, tile = copy_of(table, image) - len(mask), first_tile(table, 0, image, row)
    for col in range(table.grids[0, COLS]):
        at, right, empty = PADDING + col * SIDE, col % 2 == 1, True
        for block in range(tile_start[tile + col], tile_start[tile + col + 1]):
            if not _find_parents(live, parents, block, base, SIDE * SIDE * channels, offsets):
                continue
            weights, mask_at, step = one, 0, 0
            if mask[block] >= 0:
                weights, mask_at, step = masks, mask[block] * SIDE * SIDE, SIDE
            if transposed:
                gather_sampled(nodes, offsets, down, right, pixels, at, rows, stride, channels, weights, mask_at, step)
            elif empty:
                set_sampled(nodes, offsets, down, right, pixels, at, rows, stride, channels, weights, mask_at, step)
            else:
                add_sampled(nodes, offsets, down, right, pixels, at, rows, stride, channels, weights, mask_at, step)
            empty = False
        if empty and not transposed:
            clear_rows(pixels, at, stride, SIDE * channels)  # type: ignore[call-arg]


def _make_row_loop(gathers: bool) -> Any:
    """Make the loop over the Gaussians of a row of tiles: it adds them, or gathers their gradients.

    Pixels are those of the row, or the blocks of all nodes. Gathering fills out[e]: C colour gradients, 5 moments of
    z * SCALE, and room.
    """

    @inner
    def visit_row(lists, r, level, image, row, pixels, stride, channels, shape, sums, out, moments):  # type: ignore[no-untyped-def]
        per_tile, across = SIDE * SIDE * channels, channels * stride
        table, gaussians, entries, colors = lists.table, lists.gaussians, lists.entries, lists.colors
        num_regions, tile_start, regions, mask = table[0], table.tile_start, table.regions, table.mask
        height, width = table.grids[level, ROWS_OF_NODES], table.grids[level, COLS_OF_NODES]
        tile, first_block = first_tile(table, level, image, row), copy_of(table, image) - len(mask)
        masks, radius, lowest = table.masks, lists.radius, lists.lowest
        for e in range(lists.start[r], lists.start[r + 1]):
            i, start, end = entries[e, 0], entries[e, 1], entries[e, 2]
            region = lists.regions[i]
            if gathers:
                for k in range(len(sums)):
                    sums[k] = 0.0
            if start < 0:
                first, last = enter_rows(gaussians[i], row, height, width, radius, end, shape)
                if gathers:
                    gather_sheared(  # type: ignore[call-arg]
                        pixels, PADDING, across, stride, channels, first, last, shape, colors, i * channels, lowest,
                        end, sums, moments,
                    )  # fmt: skip
                else:
                    add_sheared(  # type: ignore[call-arg]
                        pixels, PADDING, across, stride, channels, first, last, shape, colors, i * channels, lowest, end
                    )
                start = end  # no tiles besides
            for col in range(start, end):
                block = find_block(num_regions, tile_start, regions, tile + col, region)
                if block < 0:
                    continue
                first, last = enter_tile(gaussians[i], row, col, height, width, radius, shape)
                if first >= last:
                    continue
                at, mask_at = (first_block + block) * per_tile, -1
                if level == 0:
                    at, mask_at = PADDING + col * SIDE, mask[block] * SIDE * SIDE
                if gathers:
                    gather_rows(  # type: ignore[call-arg]
                        pixels, at, across, stride, channels, first, last, shape, colors, i * channels, lowest, masks,
                        mask_at, sums, moments,
                    )  # fmt: skip
                else:
                    add_rows(  # type: ignore[call-arg]
                        pixels, at, across, stride, channels, first, last, shape, colors, i * channels, lowest, masks,
                        mask_at,
                    )  # fmt: skip
            if gathers:
                sum_columns(sums, out.shape[1], out, e * out.shape[1])  # type: ignore[call-arg]

    return visit_row


_add_row, _gather_row = _make_row_loop(False), _make_row_loop(True)


@program.entry
def render(lists, rows, image, nodes):  # type: ignore[no-untyped-def]
    """Render these rows of tiles, of nodes or of image[b, c, y, x], one after the other; see `order_rows`."""
    channels, width = image.shape[1], image.shape[3]
    stride = -(-width // SIDE) * SIDE + 2 * PADDING
    pixels, shape = np.empty(SIDE * channels * stride, np.float32), np.empty(9)
    for k in range(len(rows)):
        r, level, b, row = rows[k]
        if level == REFINEMENT:
            _refine(lists, nodes, channels, False)
            continue
        values, step = (nodes, SIDE) if level > 0 else (pixels, stride)
        if level == 0 and len(nodes) > 0:
            _sample_row(lists, b, row, pixels, stride, nodes, channels, False)
        elif level == 0:
            for at in range(len(pixels)):
                pixels[at] = 0.0
        _add_row(lists, r, level, b, row, values, step, channels, shape, None, None, False)
        if level == 0:
            _exchange(pixels, stride, image, b, row, True)


@program.entry
def gather(lists, rows, grad, out, moments, nodes):  # type: ignore[no-untyped-def]
    """Fill out[e] for the entries of these rows of tiles; `nodes` become the gradients of the nodes."""
    channels, width = grad.shape[1], grad.shape[3]
    stride = -(-width // SIDE) * SIDE + 2 * PADDING
    pixels, shape = np.zeros(SIDE * channels * stride, np.float32), np.empty(9)
    sums = np.zeros(out.shape[1] * SIDE, np.float32)
    for k in range(len(rows)):
        r, level, b, row = rows[k]
        if level == REFINEMENT:
            _refine(lists, nodes, channels, True)
            continue
        values, step = (nodes, SIDE) if level > 0 else (pixels, stride)
        if level == 0 and len(nodes) == 0 and lists.start[r] == lists.start[r + 1]:
            continue
        if level == 0:
            _exchange(pixels, stride, grad, b, row, False)
        if level == 0 and len(nodes) > 0:
            _sample_row(lists, b, row, pixels, stride, nodes, channels, True)
        _gather_row(lists, r, level, b, row, values, step, channels, shape, sums, out, moments)


@inner
def _uncoarsen(g, factors, means, cholesky, along):  # type: ignore[no-untyped-def]
    """Turn gradients of a Gaussian as its level has it into those of what was given; `along` is that of FACTOR."""
    h = float(1 << int(g[LEVEL]))
    l11, l21, l22, p11, p22 = factors[0], factors[1], factors[2], g[L11] * h, g[L22] * h
    g11, g21, g22 = cholesky[0] / h, cholesky[1] / h, cholesky[2] / h
    scaled = along * g[FACTOR]
    lost = h * h / 3 * l21 / (p11 * p11)
    last = (g22 - scaled / p22) / p22
    first = (g11 - scaled / p11) * l11 - g21 * lost + last * lost * l21 * l11 / p11
    means[0], means[1] = means[0] / h, means[1] / h
    cholesky[0] = scaled / l11 + first / p11
    cholesky[1] = g21 * l11 / p11 - last * lost
    cholesky[2] = scaled / l22 + last * l22


@program.entry
def finish(lists, order, factors, out, moments, means, cholesky, colors):  # type: ignore[no-untyped-def]
    """Add up each Gaussian's entries in float64 and turn moments into gradients, in the caller's order."""
    count, channels = colors.shape
    total = np.zeros((count, out.shape[1]))
    at, bend = np.empty(2), np.empty(3)
    for e in range(out.shape[0]):
        for k in range(out.shape[1]):
            total[lists.entries[e, 0], k] += out[e, k]
    for i in range(count):
        t, g, to = total[i], lists.gaussians[i], order[i]
        along = 0.0
        for c in range(channels):
            along += t[c] * (lists.colors[i * channels + c] / g[FACTOR])
            colors[to, c] = t[c] * g[FACTOR]
        if moments:
            s1, s2 = t[channels] / SCALE, t[channels + 1] / SCALE
            s11, s12 = t[channels + 2] / (SCALE * SCALE), t[channels + 3] / (SCALE * SCALE)
            s22 = t[channels + 4] / (SCALE * SCALE)
            slope = g[L21] / g[L22]
            at[0], at[1] = (s1 - slope * s2) / g[L11], s2 / g[L22]
            bend[0], bend[1], bend[2] = (s11 - slope * s12) / g[L11], s12 / g[L22], s22 / g[L22]
            if g[LEVEL] > 0:
                _uncoarsen(g, factors[to], at, bend, along)
            means[to, 0], means[to, 1] = at[0], at[1]
            cholesky[to, 0], cholesky[to, 1], cholesky[to, 2] = bend[0], bend[1], bend[2]
