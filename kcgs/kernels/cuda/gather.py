"""Gradients: sums over the pixels of each pair, then over the pairs of each Gaussian.

A thread owns a pair and 4 rows of its tile, and walks their pixels; the threads of a pair then add up their sums. A
program of `_reduce` owns a Gaussian, and adds the terms of its slots in order.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..interface import Gradients, SplatInputs
from ..moments import geometry_gradient
from .capacity import room_for
from .plan import PIECE, PIECES, SCALE, SIDE, CudaPlan, fails
from .render import channels_at_once, lists_of, render, weigh
from .triton_function import triton_function

# parts of a tile's rows, one for each thread of a pair
_PARTS = tl.constexpr(4)
# pixels whose loads are under way at once
_UNROLL = tl.constexpr(2)
# slots that a program of `_reduce` adds at once
_SLOTS = 64
# columns of terms that it adds at once; the first of them hold the five moments
_COLUMNS = 8

_geometry_gradient = triton.jit(geometry_gradient)


def differentiate(plan: CudaPlan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    """Return the gradients of means, cholesky (None each without `geometry`) and colors."""
    _, cholesky, colors = (t.contiguous() for t in inputs.gaussians)
    channels, total = colors.shape[-1], colors.shape[:-1].numel()
    with room_for(inputs, plan.room):
        terms = torch.empty(plan.room, channels + (5 if geometry else 0), dtype=torch.float32, device=colors.device)
    leaves = inputs.gaussians if geometry else inputs.gaussians[2:]
    grads = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in leaves]
    means_grad, cholesky_grad = grads[:2] if geometry else (None, None)
    num_pieces = plan.pieces.shape[1]
    with torch.cuda.device_of(terms):
        _gather(
            (num_pieces,), terms, grad.contiguous(), colors, plan.pieces, num_pieces,
            *lists_of(plan, inputs), *inputs.size, channels,
            BLOCK=channels_at_once(channels), MAPPED=plan.weights is not None, GEOMETRY=geometry,
        )  # fmt: skip
        _reduce(
            (total,), terms, cholesky, plan.counters, plan.gaussians, plan.slots, means_grad, cholesky_grad, grads[-1],
            total, plan.room, channels, GEOMETRY=geometry, BLOCK=_SLOTS, COLUMNS=_COLUMNS,
        )  # fmt: skip
    return means_grad, cholesky_grad, grads[-1]


def error_gradients(plan: CudaPlan, inputs: SplatInputs, target: Tensor) -> Gradients:
    """Return the gradients of half the squared error, summed over the pixels, against (B, C, H, W)."""
    return differentiate(plan, inputs, render(plan, inputs, target), True)


@triton_function(warps=1)
def _gather(
    terms, grad, colors, pieces, num_pieces,
    counters, lists, slots, coefficients, weights,
    room, num_cells, num_tiles, rows, cols, cutoff, height, width, channels,
    BLOCK: tl.constexpr, MAPPED: tl.constexpr, GEOMETRY: tl.constexpr,
):  # fmt: skip
    """Sum w g and v (z1, z2, z1 z1, z1 z2, z2 z2) over the pixels of a tile, see whitened.sums_to_gradients."""
    piece, room = tl.program_id(0), room.to(tl.int64)
    if piece >= tl.load(counters + PIECES):
        return
    tile = tl.load(pieces + piece)
    end = tl.load(lists + num_cells + tile) + tl.load(lists + 2 * num_cells + num_tiles + tile)
    thread = tl.arange(0, PIECE * _PARTS)
    first = tl.load(pieces + num_pieces + piece)
    pair = first + thread % PIECE
    valid = pair < end
    k = coefficients + pair.to(tl.int64) * 5
    k0, k1 = tl.load(k, mask=valid, other=0.0), tl.load(k + 1, mask=valid, other=0.0)
    k2, k3 = tl.load(k + 2, mask=valid, other=0.0), tl.load(k + 3, mask=valid, other=0.0)
    k4 = tl.load(k + 4, mask=valid, other=0.0)
    gaussian = tl.load(slots + room + pair, mask=valid, other=0).to(tl.int64)
    top, left, image = tile // cols % rows * SIDE, tile % cols * SIDE, (tile // (rows * cols)).to(tl.int64)
    first_row = thread // PIECE * (SIDE // _PARTS)
    if MAPPED:
        plane = tl.load(slots + 2 * room + pair, mask=valid, other=-1).to(tl.int64)
        membership = weights + plane * (SIDE * SIDE) + first_row * SIDE
    area = height.to(tl.int64) * width
    columns = channels + (5 if GEOMETRY else 0)
    s1 = tl.zeros([PIECE * _PARTS], tl.float32)
    s2, s11, s12, s22 = s1, s1, s1, s1
    for base in range(0, channels, BLOCK):
        color = ()
        sums = ()
        for c in tl.static_range(BLOCK):
            has_color = pair < tl.where(base + c < channels, end, first)
            color += (tl.load(colors + gaussian * channels + base + c, mask=has_color, other=0.0),)  # type: ignore[assignment]
            sums += (tl.zeros([PIECE * _PARTS], tl.float32),)  # type: ignore[assignment]
        corner = grad + ((image * channels + base) * height + top + first_row) * width + left
        for row in range(SIDE // _PARTS):
            y = (first_row + row) - (SIDE - 1) / 2
            for column in tl.range(tl.minimum(SIDE, width - left), loop_unroll_factor=_UNROLL):
                z1, z2, weight = weigh(k0, k1, k2, k3, k4, column - (SIDE - 1) / 2, y, cutoff)
                if MAPPED:
                    weight *= tl.load(membership + row * SIDE + column, mask=plane >= 0, other=1.0)
                product = tl.zeros([PIECE * _PARTS], tl.float32)
                added = ()
                for c in tl.static_range(BLOCK):
                    in_range = first_row + row < tl.where(base + c < channels, height - top, 0)
                    local = tl.load(corner + (c * area + row * width + column), mask=in_range, other=0.0)
                    added += (sums[c] + local * weight,)  # type: ignore[assignment]
                    product += local * color[c]
                sums = added
                if GEOMETRY:
                    first_moment = product * weight
                    second_moment = first_moment * z2
                    first_moment *= z1
                    s1 += first_moment
                    s2 += second_moment
                    s11 += first_moment * z1
                    s12 += first_moment * z2
                    s22 += second_moment * z2
        for c in tl.static_range(BLOCK):
            if base + c < channels:
                _store(terms + (5 if GEOMETRY else 0) + base + c, sums[c], first, end, columns)
    if GEOMETRY:
        _store(terms, s1, first, end, columns)
        _store(terms + 1, s2, first, end, columns)
        _store(terms + 2, s11, first, end, columns)
        _store(terms + 3, s12, first, end, columns)
        _store(terms + 4, s22, first, end, columns)


@triton.jit
def _store(address, sums, first, end, columns):
    """Add up the parts of each pair."""
    pair = first + tl.arange(0, PIECE)
    tl.store(address + pair.to(tl.int64) * columns, tl.sum(tl.reshape(sums, [_PARTS, PIECE]), axis=0), mask=pair < end)


@triton_function(warps=2)
def _reduce(
    terms, cholesky, counters, gaussians, slots, means_grad, cholesky_grad, colors_grad, total, room, channels,
    GEOMETRY: tl.constexpr, BLOCK: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Add the terms of a Gaussian in the order of its slots, and turn them into gradients."""
    g, room = tl.program_id(0), room.to(tl.int64)
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
            pair = tl.load(slots + 3 * room + begin + slot, mask=slot < count, other=-1).to(tl.int64)
            in_terms = (pair >= 0)[:, None] & (base + column < columns)[None, :]
            place = pair[:, None] * columns + base + column[None, :]
            sums += tl.sum(tl.load(terms + place, mask=in_terms, other=0.0).to(tl.float64), axis=0)
        sums = tl.where(failed, float("nan"), sums)
        if GEOMETRY and base == 0:
            s1, s2 = _column(sums, column, 0) / SCALE, _column(sums, column, 1) / SCALE
            s11, s12 = _column(sums, column, 2) / (SCALE * SCALE), _column(sums, column, 3) / (SCALE * SCALE)
            s22 = _column(sums, column, 4) / (SCALE * SCALE)
            l11 = tl.load(cholesky + 3 * g).to(tl.float64)
            l21 = tl.load(cholesky + 3 * g + 1).to(tl.float64)
            l22 = tl.load(cholesky + 3 * g + 2).to(tl.float64)
            x, y, g11, g21, g22 = _geometry_gradient(s1, s2, s11, s12, s22, l11, l21, l22)
            tl.store(means_grad + 2 * g, x.to(tl.float32))
            tl.store(means_grad + 2 * g + 1, y.to(tl.float32))
            tl.store(cholesky_grad + 3 * g, g11.to(tl.float32))
            tl.store(cholesky_grad + 3 * g + 1, g21.to(tl.float32))
            tl.store(cholesky_grad + 3 * g + 2, g22.to(tl.float32))
        channel = base + column - moments
        address = colors_grad + g.to(tl.int64) * channels + channel
        tl.store(address, sums.to(tl.float32), mask=(channel >= 0) & (channel < channels))


@triton.jit
def _column(sums, columns, column):
    return tl.sum(tl.where(columns == column, sums, 0.0), axis=0)
