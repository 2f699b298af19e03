"""The kernel `cuda`: Triton, float32; a program renders a tile of pixels or nodes, or differentiates part of its list.

Forward, a thread owns pixels and walks the tile's Gaussians; backward, it owns a Gaussian and walks the tile's pixels.
Every sum has one owner: no atomics, and the same bits every time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .interface import Gradients, SplatInputs, Steps
from .pairs import Pairs, colors_of, gradients_of, list_pairs
from .splines import gather, sample
from .tiles import TILE, expand_runs, grid_of, join_tiles, split_into_tiles, sum_runs

try:
    import triton
    import triton.language as tl
except ImportError:  # steps() raises
    triton = None

# sums of v (z1, z2, z1 z1, z1 z2, z2 z2), see whitened.sums_to_gradients
_MOMENTS = 5
# channels that a thread holds at once, in registers
_MAX_CHANNELS = 8
# Gaussians of a program of the backward, one for each thread of its one warp
_PIECE = 32
# of a program of the forward, 128 threads with two pixels each
_RENDER_WARPS = 4
# multiply and add in one: Triton 3.9 warns where it is not set, and 3.10 will leave it out
_OPTIONS = {"enable_fp_fusion": True}


class _Plan(NamedTuple):
    """The pairs in the order of their tiles, and where the list of each tile starts."""

    pairs: Pairs
    start: Tensor  # [tiles + 1] int64
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
    pairs = list_pairs(inputs)
    order = torch.argsort(pairs.tile, stable=True)
    counts = _starts(pairs.gaussian, inputs.means.shape[0] * inputs.means.shape[1]).diff()
    mask_rows, masks = None, None
    if pairs.mask_rows is not None and inputs.membership is not None:
        mask_rows = pairs.mask_rows[order]
        masks = inputs.membership.derived("cuda", lambda m: m.tiles(TILE).masks.float())
    gaussian, tile, affine = pairs.gaussian[order], pairs.tile[order], pairs.coefficients[order]
    pairs = pairs._replace(gaussian=gaussian, tile=tile, mask_rows=mask_rows, coefficients=affine)
    return _Plan(pairs, _starts(tile, pairs.num_tiles), masks, order, counts)


def _starts(values: Tensor, count: int) -> Tensor:
    """Return where each of 0 ... count - 1 starts in sorted `values`, and the end."""
    return torch.searchsorted(values, torch.arange(count + 1, device=values.device))


def _lists(plan: _Plan, inputs: SplatInputs) -> tuple[Any, ...]:
    pairs = plan.pairs
    # where there are no maps, any address will do: it is not read
    mask_rows = pairs.gaussian if pairs.mask_rows is None else pairs.mask_rows
    masks = pairs.coefficients if plan.masks is None else plan.masks
    return plan.start, pairs.coefficients, pairs.gaussian, mask_rows, masks, inputs.cutoff


def _constants(plan: _Plan, inputs: SplatInputs) -> dict[str, Any]:
    channels = inputs.colors.shape[-1]
    block = min(_MAX_CHANNELS, 1 << (channels - 1).bit_length())
    return {"SIDE": TILE, "CHANNELS": channels, "BLOCK": block, "MAPPED": plan.pairs.mask_rows is not None}


def _render(plan: _Plan, inputs: SplatInputs) -> Tensor:
    grid, channels, pairs = grid_of(inputs), inputs.colors.shape[-1], plan.pairs
    image = inputs.colors.new_empty(grid.batch, channels, *inputs.size)
    nodes = image.new_empty(pairs.num_tiles - grid.total, channels, TILE, TILE)
    colors = colors_of(pairs, inputs).contiguous()
    arguments = image, nodes, colors, grid.total, grid.rows, grid.cols, *inputs.size
    constants = _constants(plan, inputs)
    programs = pairs.num_tiles, -(-channels // constants["BLOCK"])
    with torch.cuda.device_of(image):
        _render_tile[programs](*arguments, *_lists(plan, inputs), **constants, num_warps=_RENDER_WARPS, **_OPTIONS)
    if pairs.wide is not None:
        tiles = image.new_zeros(grid.total, channels, TILE, TILE)
        sample(nodes, pairs.wide.nodes, plan.masks, tiles)
        image += join_tiles(tiles.unflatten(0, grid), inputs.size)
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
    by_tile = split_into_tiles(grad).flatten(0, 2)
    if plan.pairs.wide is not None:
        by_tile = torch.cat([by_tile, gather(by_tile, plan.pairs.wide.nodes, plan.masks)])
    by_tile = by_tile.permute(0, 2, 3, 1).contiguous()
    # channels first, so that the compiler gives whole Gaussians to threads
    colors = colors_of(plan.pairs, inputs).T.contiguous()
    arguments = terms, plan.order, tile, first, by_tile, colors, colors.shape[1]
    constants = {**_constants(plan, inputs), "GEOMETRY": geometry, "PIECE": _PIECE}
    with torch.cuda.device_of(terms):
        _gather_piece[(len(tile),)](*arguments, *_lists(plan, inputs), **constants, num_warps=1, **_OPTIONS)
    return gradients_of(plan.pairs, inputs, sum_runs(terms, plan.counts))


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
    image, nodes, colors, pixel_tiles, rows, cols, height, width,
    start, coefficients, gaussian, mask_rows, masks, cutoff,
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
            mask_row = tl.load(mask_rows + i)
            if mask_row >= 0:
                weight *= tl.load(masks + mask_row * (SIDE * SIDE) + pixel)
        color = tl.load(colors + tl.load(gaussian + i) * CHANNELS + channel, mask=channel < CHANNELS, other=0.0)
        value += color * weight[None, :]

    if tile < pixel_tiles:
        batch, local = tile // (rows * cols), tile % (rows * cols)
        down, across = row + local // cols * SIDE, column + local % cols * SIDE
        address = ((batch * CHANNELS + channel) * height + down[None, :]) * width + across[None, :]
        inside = (down < height) & (across < width)
        tl.store(image + address, value, mask=(channel < CHANNELS) & inside[None, :])
    else:
        address = ((tile - pixel_tiles) * CHANNELS + channel) * (SIDE * SIDE) + pixel[None, :]
        tl.store(nodes + address, value, mask=channel < CHANNELS)


@_jit
def _gather_piece(  # type: ignore[no-untyped-def]
    terms, order, tiles, firsts, grad, colors, count, start, coefficients, gaussian, mask_rows, masks, cutoff,
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
    member = tl.load(gaussian + entry, mask=valid, other=0)
    if MAPPED:
        mask_row = tl.load(mask_rows + entry, mask=valid, other=-1)

    width: tl.constexpr = CHANNELS + (5 if GEOMETRY else 0)
    target = terms + tl.load(order + entry, mask=valid, other=0) * width
    zero = tl.zeros([PIECE], tl.float32)
    s1, s2, s11, s12, s22 = zero, zero, zero, zero, zero
    for base in range(0, CHANNELS, BLOCK):
        channel = base + tl.arange(0, BLOCK)[:, None]
        in_range = channel < CHANNELS
        color = tl.load(
            colors + channel.to(tl.int64) * count + member[None, :], mask=in_range & valid[None, :], other=0.0
        )
        sums = tl.zeros([BLOCK, PIECE], tl.float32)
        for row in range(SIDE):
            for column in range(SIDE):
                z1, z2, weight = _weigh(k0, k1, k2, k3, k4, column - (SIDE - 1) / 2, row - (SIDE - 1) / 2, cutoff)
                pixel = row * SIDE + column
                if MAPPED:
                    weight *= tl.load(masks + mask_row * (SIDE * SIDE) + pixel, mask=mask_row >= 0, other=1.0)
                local = tl.load(grad + (tile * (SIDE * SIDE) + pixel) * CHANNELS + channel, mask=in_range, other=0.0)
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
        tl.store(target[None, :] + channel, sums, mask=in_range & valid[None, :])
    if GEOMETRY:
        tl.store(target + CHANNELS, s1, mask=valid)
        tl.store(target + CHANNELS + 1, s2, mask=valid)
        tl.store(target + CHANNELS + 2, s11, mask=valid)
        tl.store(target + CHANNELS + 3, s12, mask=valid)
        tl.store(target + CHANNELS + 4, s22, mask=valid)
