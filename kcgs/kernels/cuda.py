"""The splat in Triton, in float32: a program renders a tile of 16 x 16 pixels, or differentiates a piece of its list.

Forward, a thread owns pixels and walks the tile's Gaussians; backward, it owns a Gaussian and walks the tile's pixels.
Every sum has one owner: no atomics, and the same bits every time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .inputs import Gradients, SplatInputs, Steps
from .tiles import TILE, Pairs, bin_gaussians, coefficients, expand_runs, grid_of, split_into_tiles, sum_runs
from .whitened import sums_to_gradients

try:
    import triton
    import triton.language as tl
except ImportError:  # splat says so
    triton = None

_MOMENTS = 5
# channels that a thread holds at once
_MOST_CHANNELS = 8
# Gaussians of a program of the backward, one for each thread of its one warp
_PIECE = 32
_RENDER_WARPS = 4
# multiply and add in one: Triton 3.9 warns where it is not said, and 3.10 will leave it out
_OPTIONS = {"enable_fp_fusion": True}


class _Plan(NamedTuple):
    """Pairs in the order of their tiles, and where the list of each tile starts."""

    start: Tensor  # [tiles + 1] int64
    coefficients: Tensor  # [P, 5]: z1 = k0 + k1 x, z2 = k2 + k3 x + k4 y in tile-centred pixels
    gaussian: Tensor  # [P] int64, b * N + i
    mask: Tensor | None  # [P] int64 row of masks, -1: weight 1
    masks: Tensor | None  # [K, 256] float32
    order: Tensor  # [P] int64, the pair's place in the order of the Gaussians
    counts: Tensor  # [B * N] int64, pairs of each Gaussian


def steps(inputs: SplatInputs) -> Steps:
    """Return the kernel, if it takes these inputs."""
    dtype, device = inputs.means.dtype, inputs.means.device
    if dtype != torch.float32:
        raise ValueError(f"backend 'cuda' computes in float32; got {dtype}: use 'tiled' or 'reference'")
    if device.type != "cuda" and not _interpreted():
        raise ValueError(f"backend 'cuda' needs tensors on a CUDA device; got {device}")
    if triton is None:
        raise ImportError("backend 'cuda' needs Triton: pip install triton")
    return Steps(_make_plan, _render, _differentiate)


def _interpreted() -> bool:
    """Whether TRITON_INTERPRET=1 was set when triton was imported: the kernels run in numpy, on CPU tensors."""
    return triton is not None and not isinstance(_render_tile, triton.JITFunction)


def _make_plan(inputs: SplatInputs) -> _Plan:
    pairs = bin_gaussians(inputs)
    order = torch.argsort(pairs.tile, stable=True)
    counts = _starts(pairs.gaussian, inputs.means.shape[0] * inputs.means.shape[1]).diff()
    mask, masks = None, None
    if pairs.mask is not None and inputs.membership is not None:
        mask, masks = pairs.mask[order], inputs.membership.derived("cuda", lambda m: m.tiles(TILE).masks.float())
    pairs = Pairs(pairs.gaussian[order], pairs.tile[order], mask, pairs.origin[order])
    start = _starts(pairs.tile, grid_of(inputs).total)
    return _Plan(start, coefficients(pairs, inputs), pairs.gaussian, pairs.mask, masks, order, counts)


def _starts(values: Tensor, total: int) -> Tensor:
    """Where each of 0 ... total - 1, and the end, starts in sorted `values`."""
    return torch.searchsorted(values, torch.arange(total + 1, device=values.device))


def _lists(plan: _Plan, inputs: SplatInputs) -> tuple[Any, ...]:
    # where there are no maps, any address will do: it is not read
    mask = plan.gaussian if plan.mask is None else plan.mask
    masks = plan.coefficients if plan.masks is None else plan.masks
    return plan.start, plan.coefficients, plan.gaussian, mask, masks, inputs.cutoff


def _constants(plan: _Plan, inputs: SplatInputs) -> dict[str, Any]:
    channels = inputs.colors.shape[-1]
    block = min(_MOST_CHANNELS, 1 << (channels - 1).bit_length())
    return {"SIDE": TILE, "CHANNELS": channels, "BLOCK": block, "MAPPED": plan.mask is not None}


def _render(plan: _Plan, inputs: SplatInputs) -> Tensor:
    grid, channels = grid_of(inputs), inputs.colors.shape[-1]
    image = inputs.colors.new_empty(grid.batch, channels, *inputs.size)
    colors = inputs.colors.detach().flatten(0, 1).contiguous()
    arguments = image, colors, grid.rows, grid.cols, *inputs.size
    constants = _constants(plan, inputs)
    programs = grid.total, -(-channels // constants["BLOCK"])
    with torch.cuda.device_of(image):
        _render_tile[programs](*arguments, *_lists(plan, inputs), **constants, num_warps=_RENDER_WARPS, **_OPTIONS)
    return image


def _differentiate(plan: _Plan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    if not len(plan.order):
        means, cholesky, colors = (torch.zeros_like(t) for t in inputs[:3])
        return (means, cholesky, colors) if geometry else (None, None, colors)
    channels = inputs.colors.shape[-1]
    terms = inputs.colors.new_empty(len(plan.order), channels + (_MOMENTS if geometry else 0))
    # pieces of the tiles' lists: their tiles and first pairs
    tile, piece = expand_runs((plan.start.diff() + _PIECE - 1) // _PIECE)
    first = plan.start[tile] + piece * _PIECE
    by_tile = split_into_tiles(grad).permute(0, 1, 2, 4, 5, 3).reshape(-1, TILE * TILE, channels).contiguous()
    # channels first, so that the compiler gives whole Gaussians to threads
    colors = inputs.colors.detach().flatten(0, 1).T.contiguous()
    arguments = terms, plan.order, tile, first, by_tile, colors, colors.shape[1]
    constants = {**_constants(plan, inputs), "GEOMETRY": geometry, "PIECE": _PIECE}
    with torch.cuda.device_of(terms):
        _gather_piece[(len(tile),)](*arguments, *_lists(plan, inputs), **constants, num_warps=1, **_OPTIONS)
    total = sum_runs(terms, plan.counts).unflatten(0, inputs.means.shape[:2])
    return sums_to_gradients(total, channels, inputs.cholesky)


def _jit(function: Any) -> Any:
    return function if triton is None else triton.jit(function)


@_jit
def _weigh(k0, k1, k2, k3, k4, x, y, cutoff):  # type: ignore[no-untyped-def]
    z1 = k0 + k1 * x
    z2 = k2 + k4 * y + k3 * x
    weight = tl.exp(-0.5 * (z1 * z1 + z2 * z2))
    return z1, z2, tl.where(weight >= cutoff, weight, 0.0)


@_jit
def _render_tile(  # type: ignore[no-untyped-def]
    image, colors, rows, cols, height, width, start, coefficients, gaussian, mask_of, masks, cutoff,
    SIDE: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr, MAPPED: tl.constexpr,
):  # fmt: skip
    tile = tl.program_id(0).to(tl.int64)
    pixel = tl.arange(0, SIDE * SIDE)
    column, row = pixel % SIDE, pixel // SIDE
    x, y = column - (SIDE - 1) / 2, row - (SIDE - 1) / 2
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)[:, None]
    value = tl.zeros([BLOCK, SIDE * SIDE], tl.float32)
    for i in range(tl.load(start + tile), tl.load(start + tile + 1)):
        k = coefficients + 5 * i
        _, _, weight = _weigh(tl.load(k), tl.load(k + 1), tl.load(k + 2), tl.load(k + 3), tl.load(k + 4), x, y, cutoff)
        if MAPPED:
            which_mask = tl.load(mask_of + i)
            if which_mask >= 0:
                weight *= tl.load(masks + which_mask * (SIDE * SIDE) + pixel)
        color = tl.load(colors + tl.load(gaussian + i) * CHANNELS + channel, mask=channel < CHANNELS, other=0.0)
        value += color * weight[None, :]

    batch, local = tile // (rows * cols), tile % (rows * cols)
    row += local // cols * SIDE
    column += local % cols * SIDE
    at = ((batch * CHANNELS + channel) * height + row[None, :]) * width + column[None, :]
    inside = (row < height) & (column < width)
    tl.store(image + at, value, mask=(channel < CHANNELS) & inside[None, :])


@_jit
def _gather_piece(  # type: ignore[no-untyped-def]
    terms, order, tiles, firsts, grad, colors, count, start, coefficients, gaussian, mask_of, masks, cutoff,
    SIDE: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr, MAPPED: tl.constexpr, GEOMETRY: tl.constexpr,
    PIECE: tl.constexpr,
):  # fmt: skip
    tile = tl.load(tiles + tl.program_id(0))
    entry = tl.load(firsts + tl.program_id(0)) + tl.arange(0, PIECE)
    valid = entry < tl.load(start + tile + 1)
    k = coefficients + 5 * entry
    k0, k1 = tl.load(k, mask=valid, other=0.0), tl.load(k + 1, mask=valid, other=0.0)
    k2, k3 = tl.load(k + 2, mask=valid, other=0.0), tl.load(k + 3, mask=valid, other=0.0)
    k4 = tl.load(k + 4, mask=valid, other=0.0)
    which = tl.load(gaussian + entry, mask=valid, other=0)
    if MAPPED:
        which_mask = tl.load(mask_of + entry, mask=valid, other=-1)

    width: tl.constexpr = CHANNELS + (5 if GEOMETRY else 0)
    at = terms + tl.load(order + entry, mask=valid, other=0) * width
    zero = tl.zeros([PIECE], tl.float32)
    s1, s2, s11, s12, s22 = zero, zero, zero, zero, zero
    for base in range(0, CHANNELS, BLOCK):
        channel = base + tl.arange(0, BLOCK)[:, None]
        known = channel < CHANNELS
        color = tl.load(colors + channel.to(tl.int64) * count + which[None, :], mask=known & valid[None, :], other=0.0)
        sums = tl.zeros([BLOCK, PIECE], tl.float32)
        for row in range(SIDE):
            for column in range(SIDE):
                z1, z2, weight = _weigh(k0, k1, k2, k3, k4, column - (SIDE - 1) / 2, row - (SIDE - 1) / 2, cutoff)
                pixel = row * SIDE + column
                if MAPPED:
                    weight *= tl.load(masks + which_mask * (SIDE * SIDE) + pixel, mask=which_mask >= 0, other=1.0)
                local = tl.load(grad + (tile * (SIDE * SIDE) + pixel) * CHANNELS + channel, mask=known, other=0.0)
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
        tl.store(at[None, :] + channel, sums, mask=known & valid[None, :])
    if GEOMETRY:
        tl.store(at + CHANNELS, s1, mask=valid)
        tl.store(at + CHANNELS + 1, s2, mask=valid)
        tl.store(at + CHANNELS + 2, s11, mask=valid)
        tl.store(at + CHANNELS + 3, s12, mask=valid)
        tl.store(at + CHANNELS + 4, s22, mask=valid)
