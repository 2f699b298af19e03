"""Gradients: sums over the pixels of each pair, then over the pairs of each Gaussian.

A thread owns a pair, 32 to a program, and walks some rows of the tile; the rows of a tile are split between programs
where tiles alone are too few for a GPU. A program owns a Gaussian, and adds its slots in order.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..interface import Gradients, SplatInputs
from .plan import OPTIONS, PIECE, PIECES, SCALE, SIDE, Plan, fails, program
from .render import channels_at_once, lists_of, render, weigh

# tiles below which the rows of a tile are split, and into how many parts
_FEW_TILES, _PARTS = 8192, 4
# pixels whose loads are under way at once
_UNROLL = tl.constexpr(4)
# slots that a program adds at once, and columns of terms
_SLOTS, _COLUMNS = 128, 8
_SLOTS_WARPS = 4


def differentiate(plan: Plan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    """Return the gradients of means, cholesky (None each without `geometry`) and colors."""
    _, cholesky, colors = (t.contiguous() for t in inputs.gaussians)
    channels, total = colors.shape[-1], colors.shape[:-1].numel()
    parts = _PARTS if plan.grid.total < _FEW_TILES else 1
    terms = torch.empty(parts, plan.room, channels + (5 if geometry else 0), device=colors.device)
    leaves = inputs.gaussians if geometry else inputs.gaussians[2:]
    grads = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in leaves]
    means_grad, cholesky_grad = grads[:2] if geometry else (None, None)
    lists, mapped, num_pieces = lists_of(plan, inputs), inputs.coverage is not None, plan.pieces.shape[1]
    with torch.cuda.device_of(terms):
        _gather[(num_pieces, parts)](
            terms, terms.stride(2), grad, *(0, *grad.stride())[-4:], colors, colors.stride(-1), plan.pieces,
            num_pieces, *lists, *inputs.size, channels,
            BLOCK=channels_at_once(channels), MAPPED=mapped, GEOMETRY=geometry, PARTS=parts, num_warps=1, **OPTIONS,
        )  # fmt: skip
        _reduce[(total,)](
            terms, cholesky, plan.counters, plan.gaussians, plan.slots, means_grad, cholesky_grad, grads[-1],
            total, plan.room, channels,
            GEOMETRY=geometry, PARTS=parts, BLOCK=_SLOTS, COLUMNS=_COLUMNS, num_warps=_SLOTS_WARPS, **OPTIONS,
        )  # fmt: skip
    return means_grad, cholesky_grad, grads[-1]


def error_gradients(plan: Plan, inputs: SplatInputs, target: Tensor) -> Gradients:
    """Return the gradients of half the squared error, summed over the pixels, against (B, C, H, W)."""
    return differentiate(plan, inputs, render(plan, inputs, target), True)


@program(
    "term_stride image_stride channel_stride row_stride column_stride color_stride num_pieces "
    "room num_cells num_tiles rows cols height width channels"
)
def _gather(  # type: ignore[no-untyped-def]
    terms, term_stride, grad, image_stride, channel_stride, row_stride, column_stride, colors, color_stride, pieces,
    num_pieces,
    counters, lists, slots, coefficients, weights,
    room, num_cells, num_tiles, rows, cols, cutoff, height, width, channels,
    BLOCK: tl.constexpr, MAPPED: tl.constexpr, GEOMETRY: tl.constexpr, PARTS: tl.constexpr,
):  # fmt: skip
    """Sum, over some rows of a tile, w g and v (z1, z2, z1 z1, z1 z2, z2 z2), see whitened.sums_to_gradients."""
    piece, part = tl.program_id(0), tl.program_id(1)
    if piece >= tl.load(counters + PIECES):
        return
    tile = tl.load(pieces + piece)
    end = tl.load(lists + num_cells + tile) + tl.load(lists + 2 * num_cells + num_tiles + tile)
    pair = tl.load(pieces + num_pieces + piece) + tl.arange(0, PIECE)
    valid = pair < end
    k = coefficients + pair.to(tl.int64) * 5
    k0, k1 = tl.load(k, mask=valid, other=0.0), tl.load(k + 1, mask=valid, other=0.0)
    k2, k3 = tl.load(k + 2, mask=valid, other=0.0), tl.load(k + 3, mask=valid, other=0.0)
    k4 = tl.load(k + 4, mask=valid, other=0.0)
    gaussian = tl.load(slots + room + pair, mask=valid, other=0).to(tl.int64)
    if MAPPED:
        plane = tl.load(slots + 2 * room + pair, mask=valid, other=-1)
        is_shared = plane >= 0
        membership = weights + plane * (SIDE * SIDE)
    top, left, image = tile // cols % rows * SIDE, tile % cols * SIDE, (tile // (rows * cols)).to(tl.int64)
    corner = grad + image * image_stride + top * row_stride + left * column_stride
    first_row, last_row = part * (SIDE // PARTS), tl.minimum((part + 1) * (SIDE // PARTS), height - top)
    last_column = tl.minimum(SIDE, width - left)
    target = terms + (part.to(tl.int64) * room + pair) * (channels + (5 if GEOMETRY else 0))
    zero = tl.zeros([PIECE], tl.float32)
    s1, s2, s11, s12, s22 = zero, zero, zero, zero, zero
    for base in range(0, channels, BLOCK):
        channel = base + tl.arange(0, BLOCK)[:, None]
        in_range = channel < channels
        # steps of channels that the compiler does not know: it would spread a pair's channels over threads
        address = colors + gaussian[None, :] * channels + channel * color_stride
        color = tl.load(address, mask=in_range & valid[None, :], other=0.0)
        sums = tl.zeros([BLOCK, PIECE], tl.float32)
        for row in range(first_row, last_row):
            pixel = corner + row * row_stride + channel * channel_stride
            for column in tl.range(last_column, loop_unroll_factor=_UNROLL):
                z1, z2, weight = weigh(k0, k1, k2, k3, k4, column - (SIDE - 1) / 2, row - (SIDE - 1) / 2, cutoff)
                if MAPPED:
                    weight *= tl.load(membership + row * SIDE + column, mask=is_shared, other=1.0)
                local = tl.load(pixel, mask=in_range, other=0.0)
                pixel += column_stride
                sums += local * weight[None, :]
                if GEOMETRY:
                    first = tl.sum(local * color, axis=0) * weight
                    second = first * z2
                    first *= z1
                    s1 += first
                    s2 += second
                    s11 += first * z1
                    s12 += first * z2
                    s22 += second * z2
        address = target[None, :] + ((5 if GEOMETRY else 0) + channel) * term_stride
        tl.store(address, sums, mask=in_range & valid[None, :])
    if GEOMETRY:
        tl.store(target, s1, mask=valid)
        tl.store(target + 1, s2, mask=valid)
        tl.store(target + 2, s11, mask=valid)
        tl.store(target + 3, s12, mask=valid)
        tl.store(target + 4, s22, mask=valid)


@program("total room channels")
def _reduce(  # type: ignore[no-untyped-def]
    terms, cholesky, counters, gaussians, slots, means_grad, cholesky_grad, colors_grad, total, room, channels,
    GEOMETRY: tl.constexpr, PARTS: tl.constexpr, BLOCK: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Add the terms of a Gaussian in the order of its slots, and turn them into gradients."""
    g = tl.program_id(0)
    moments: tl.constexpr = 5 if GEOMETRY else 0
    columns = channels + moments
    first, last = tl.load(gaussians + g), tl.load(gaussians + total + g)
    down, across = (last >> 16) - (first >> 16) + 1, (last & 0xFFFF) - (first & 0xFFFF) + 1
    failed = fails(counters, room)
    count = tl.where(failed, 0, down * across)
    begin = tl.load(gaussians + 2 * total + g)
    column = tl.arange(0, COLUMNS)
    for base in range(0, columns, COLUMNS):
        sums = tl.zeros([COLUMNS], tl.float64)
        for k in range(0, count, BLOCK):
            slot = k + tl.arange(0, BLOCK)
            pair = tl.load(slots + 3 * room + begin + slot, mask=slot < count, other=-1)
            kept = (pair >= 0)[:, None] & (base + column < columns)[None, :]
            for part in range(PARTS):
                place = (part * room.to(tl.int64) + pair)[:, None] * columns + base + column[None, :]
                sums += tl.sum(tl.load(terms + place, mask=kept, other=0.0).to(tl.float64), axis=0)
        sums = tl.where(failed, float("nan"), sums)
        if GEOMETRY and base == 0:
            s1, s2 = _at(sums, column, 0) / SCALE, _at(sums, column, 1) / SCALE
            s11, s12 = _at(sums, column, 2) / (SCALE * SCALE), _at(sums, column, 3) / (SCALE * SCALE)
            s22 = _at(sums, column, 4) / (SCALE * SCALE)
            l11 = tl.load(cholesky + 3 * g).to(tl.float64)
            l21 = tl.load(cholesky + 3 * g + 1).to(tl.float64)
            l22 = tl.load(cholesky + 3 * g + 2).to(tl.float64)
            slope = l21 / l22
            tl.store(means_grad + 2 * g, ((s1 - slope * s2) / l11).to(tl.float32))
            tl.store(means_grad + 2 * g + 1, (s2 / l22).to(tl.float32))
            tl.store(cholesky_grad + 3 * g, ((s11 - slope * s12) / l11).to(tl.float32))
            tl.store(cholesky_grad + 3 * g + 1, (s12 / l22).to(tl.float32))
            tl.store(cholesky_grad + 3 * g + 2, (s22 / l22).to(tl.float32))
        channel = base + column - moments
        address = colors_grad + g.to(tl.int64) * channels + channel
        tl.store(address, sums.to(tl.float32), mask=(channel >= 0) & (channel < channels))


@triton.jit
def _at(values, places, place):  # type: ignore[no-untyped-def]
    return tl.sum(tl.where(places == place, values, 0.0), axis=0)
