"""The kernel `tiled`: plain torch over tiles of 16 x 16 pixels, in float32 and float64, on any device.

The Gaussians of a tile and a region are cut into pieces of one length, and these are evaluated chunk by chunk. The
gradient is autograd's: a chunk is evaluated again when it is differentiated, so that memory stays flat.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad, threshold

from kcgs._torch_internals import with_autograd
from kcgs.maps import TILE, table_at

from .interface import Gradients, Kernel, SplatInputs
from .tiles import (
    TileGrid,
    bounding_tiles,
    coefficients,
    expand_runs,
    find_keys,
    grid_of,
    join_tiles,
    reaches,
    split_into_tiles,
    sum_runs,
)
from .whitened import least_exponent, sums_to_gradients, support_radius

# pairs per piece: longer pieces would be mostly padding, shorter pieces would be more pieces to sum
_PIECE = 16
# pieces per chunk: their weights are 2 MiB in float32, more would leave the caches
_CHUNK = 128


class _Plan(NamedTuple):
    """The (Gaussian, tile) pairs whose weight may not be zero, and pieces: pairs of one tile and one region.

    Since no piece has two regions, the Gaussians of one region change no bit of another.
    """

    gaussian: Tensor  # [P] int64, b * N + i, ascending
    coefficients: Tensor  # [P, 5], in the dtype of the inputs: see tiles.coefficients
    pieces: Tensor  # [S, _PIECE] int64 into the pairs, padded with -1
    tile: Tensor  # [S] int64, ascending
    mask_rows: Tensor  # [S] int32 into masks
    masks: Tensor  # [K + 1, 256], in the dtype of the inputs; the last row, at index -1, is all ones


class _Chunk(NamedTuple):
    """The inputs of some pieces."""

    pieces: Tensor  # [T, _PIECE] int64
    tile: Tensor  # [T] int64
    coefficients: Tensor  # [T, _PIECE, 5]
    colors: Tensor  # [T, _PIECE, C], 0 in the padding
    masks: Tensor  # [T, 1, 256]


def kernel_for(inputs: SplatInputs) -> Kernel:
    """Return the kernel."""
    return Kernel(_make_plan, _render, _differentiate)


def _make_plan(inputs: SplatInputs) -> _Plan:
    starts, regions, planes, weights, num_regions = _tile_regions(inputs)
    grid, keys = grid_of(inputs), keys_of(starts, regions, num_regions)
    gaussian, block, affine = _list_pairs(inputs, grid, keys, num_regions)
    order = torch.argsort(block, stable=True)
    blocks, lengths = torch.unique_consecutive(block[order], return_counts=True)
    run, piece = expand_runs(-(-lengths // _PIECE))
    rank = piece[:, None] * _PIECE + torch.arange(_PIECE, device=order.device)
    position = (lengths.cumsum(0) - lengths)[run, None] + rank
    pieces = torch.where(rank < lengths[run, None], pad(order, (0, _PIECE))[position], -1)
    image, row = blocks[run] // len(keys), blocks[run] % len(keys)
    tiles = grid.rows * grid.cols
    tile = image * tiles + keys[row] // num_regions % tiles
    masks = pad(weights.to(affine.dtype), (0, 0, 0, 1), value=1.0)
    return _Plan(gaussian, affine, pieces, tile, planes[row], masks)


def _tile_regions(inputs: SplatInputs) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """Return the tiles of the map, and the number of regions; without a map, one region covers everything."""
    if inputs.table is not None:
        return *table_at(inputs.table, inputs.size).tiles, inputs.table.num_regions
    grid = grid_of(inputs)
    starts = torch.arange(grid.rows * grid.cols + 1, device=inputs.means.device)
    alone = torch.zeros_like(starts[1:])
    return starts, alone, alone - 1, inputs.means.new_zeros(0, TILE * TILE), 1


def keys_of(starts: Tensor, regions: Tensor, num_regions: int) -> Tensor:
    """Return the key tile * num_regions + region of each entry; keys ascend."""
    return torch.repeat_interleave(starts.diff()).long() * num_regions + regions


def _list_pairs(inputs: SplatInputs, grid: TileGrid, keys: Tensor, num_regions: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return Gaussians, blocks and coefficients of pairs, in the order of the Gaussians.

    The block of image b and key k is b * len(keys) + k, also where images have maps of their own.
    """
    means, cholesky = (t.detach().double().flatten(0, 1) for t in inputs[:2])
    radius = support_radius(inputs.cutoff, inputs.means.dtype)
    gaussian, place, origin = bounding_tiles(means, cholesky, radius, inputs.size)
    image, tile = gaussian // inputs.means.shape[1], place[:, 1] * grid.cols + place[:, 0]
    if inputs.table is not None and inputs.table.shape[0] > 1:
        tile = image * grid.rows * grid.cols + tile
    positions = inputs.region_positions
    region = torch.zeros_like(gaussian) if positions is None else positions.flatten()[gaussian]
    row, is_present = find_keys(keys, tile, region, num_regions)
    pairs = (is_present & reaches(origin, cholesky[gaussian], radius)).nonzero().flatten()
    gaussian, block = gaussian[pairs], (image * len(keys) + row)[pairs]
    return gaussian, block, coefficients(origin[pairs], cholesky[gaussian]).to(inputs.means.dtype)


def _chunks(plan: _Plan, inputs: SplatInputs) -> Iterator[_Chunk]:
    colors = inputs.colors.detach().flatten(0, 1)
    for begin in range(0, len(plan.pieces), _CHUNK):
        pieces, tile, mask_rows = (t[begin : begin + _CHUNK] for t in (plan.pieces, plan.tile, plan.mask_rows))
        members = colors[plan.gaussian[pieces]].masked_fill(pieces[..., None] < 0, 0.0)
        yield _Chunk(pieces, tile, plan.coefficients[pieces], members, plan.masks[mask_rows, None])


def _evaluate(chunk: _Chunk, cutoff: float) -> Tensor:
    """Sum the Gaussians of each piece over its tile, (T, C, 256)."""
    k0, k1, k2, k3, k4 = chunk.coefficients[..., None, None].unbind(2)
    offset = torch.arange(TILE, device=k0.device, dtype=k0.dtype) - (TILE - 1) / 2
    # element by element, since users may set a lower precision for matrix products on a GPU
    z1 = k0 + k1 * offset  # [T, _PIECE, 1, 16]
    z2 = k2 + k4 * offset[:, None] + k3 * offset  # [T, _PIECE, 16, 16]
    least = least_exponent(cutoff, k0.dtype)
    # exp() is slow where its result is no normal number, and `threshold` is faster than `where`
    exponent = threshold(-0.5 * (z1.square() + z2.square()), least - 1, least - 1)
    weight = threshold(exponent.exp(), math.exp(least), 0.0)
    return chunk.colors.mT @ weight.flatten(2) * chunk.masks


def _render(plan: _Plan, inputs: SplatInputs) -> Tensor:
    grid, channels = grid_of(inputs), inputs.colors.shape[-1]
    tiles = inputs.colors.new_zeros(grid.total, channels * TILE * TILE)
    for chunk in _chunks(plan, inputs):
        values = _evaluate(chunk, inputs.cutoff).flatten(1)
        tile, counts = torch.unique_consecutive(chunk.tile, return_counts=True)
        # pieces of a tile are added one after the other, also across chunks: the bits do not depend on the chunks
        values[counts.cumsum(0) - counts] += tiles[tile]
        tiles[tile] = sum_runs(values, counts)
    return join_tiles(tiles.view(*grid, channels, TILE, TILE), inputs.size)


def _differentiate(plan: _Plan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    grad = split_into_tiles(grad).flatten(0, 2).flatten(2)  # [tiles, C, 256]
    shape, channels = inputs.means.shape[:2], inputs.colors.shape[-1]
    # one more row, for the padding
    terms = grad.new_empty(len(plan.gaussian) + 1, channels + (5 if geometry else 0))
    for chunk in _chunks(plan, inputs):
        leaves = [t.requires_grad_() for t in ((chunk.colors, chunk.coefficients) if geometry else (chunk.colors,))]
        with with_autograd():
            gradients = torch.autograd.grad(_evaluate(chunk, inputs.cutoff), leaves, grad[chunk.tile])
        moments = [_moments(chunk.coefficients.detach(), gradients[1])] if geometry else []
        terms[chunk.pieces] = torch.cat([gradients[0], *moments], -1)
    sums = sum_runs(terms[:-1], torch.bincount(plan.gaussian, minlength=shape.numel()))
    return sums_to_gradients(sums.unflatten(0, shape), channels, inputs.cholesky.detach())


def _moments(coefficients: Tensor, grad: Tensor) -> Tensor:
    """Turn gradients of coefficients, [..., 5], into the moments that `sums_to_gradients` takes."""
    # products may be beyond float32
    (k0, k1, k2, k3, k4), (g0, g1, g2, g3, g4) = (t.double().unbind(-1) for t in (coefficients, grad))
    rows = [g0, g2, k0 * g0 + k1 * g1, k0 * g2 + k1 * g3, k2 * g2 + k3 * g3 + k4 * g4]
    return -torch.stack(rows, -1).to(grad.dtype)
