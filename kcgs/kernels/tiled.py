"""The kernel `tiled`: batched matrix products over tiles of 16 x 16 pixels, any device, backward by hand.

Whitened coordinates are affine in the pixel, so for a whole tile they are two small matrix products in tile-centred
coordinates whose constants are made in float64; the image and the colour gradients are batched products too.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from .interface import Gradients, SplatInputs, Steps
from .pairs import Pairs, colors_of, gradients_of, list_pairs
from .splines import gather, sample
from .tiles import TILE, expand_runs, grid_of, join_tiles, split_into_tiles, sum_runs
from .whitened import least_exponent

# weights (pairs times pixels) of a batch, 1 MiB in float32: more would leave the caches, fewer take more calls
_CHUNK_WEIGHTS = 1 << 18
# pairs of a segment: a tile with more has several
_MAX_SEGMENT = 1024
# of a tile
_PIXELS = TILE * TILE


class _Batch(NamedTuple):
    """Tile segments of similar list length, padded to the longest."""

    segments: Tensor  # [T] int64
    entries: Tensor  # [T, G] int64 into the pairs, padded with the number of pairs
    mixed: bool  # whether the tiles hold several regions, and so have masks


class _Plan(NamedTuple):
    pairs: Pairs
    batches: list[_Batch]
    segment_tile: Tensor  # [S] int64, ascending
    coefficients: Tensor  # [P + 1, 5]
    masks: Tensor | None  # [K, 256], in the dtype of the inputs


def steps(inputs: SplatInputs) -> Steps:
    """Return the kernel."""
    return Steps(_make_plan, _render, _differentiate)


def _make_plan(inputs: SplatInputs) -> _Plan:
    pairs = list_pairs(inputs)
    masks = None
    if pairs.mask_rows is not None and inputs.membership is not None:
        masks = inputs.membership.tiles(TILE).masks.to(inputs.means.dtype)

    # segments: a tile's list cut into pieces of at most _MAX_SEGMENT
    order = torch.argsort(pairs.tile, stable=True)
    tiles, lengths = torch.unique_consecutive(pairs.tile[order], return_counts=True)
    run, piece = expand_runs(-(-lengths // _MAX_SEGMENT))
    start = (lengths.cumsum(0) - lengths)[run] + piece * _MAX_SEGMENT
    length = (lengths[run] - piece * _MAX_SEGMENT).clamp_max(_MAX_SEGMENT)
    mixed = torch.zeros_like(length, dtype=torch.bool)
    if pairs.mask_rows is not None:
        mixed = pairs.mask_rows[order][start] >= 0
    batches = [
        batch
        for kind in (False, True)
        for batch in _batches((mixed == kind).nonzero().flatten(), start, length, order, kind)
    ]
    return _Plan(pairs, batches, tiles[run], _padded(pairs.coefficients), masks)


def _batches(segments: Tensor, start: Tensor, length: Tensor, order: Tensor, mixed: bool) -> Iterator[_Batch]:
    segments = segments[torch.argsort(length[segments], descending=True, stable=True)]
    lengths = length[segments].tolist()
    begin = 0
    while begin < len(lengths):
        longest = lengths[begin]
        end = min(len(lengths), begin + max(1, _CHUNK_WEIGHTS // (longest * _PIXELS)))
        part = segments[begin:end]
        step = torch.arange(longest, device=order.device)
        valid = step < length[part, None]
        entries = torch.where(valid, order[(start[part, None] + step).clamp_max(len(order) - 1)], len(order))
        yield _Batch(part, entries, mixed)
        begin = end


def _padded(rows: Tensor) -> Tensor:
    return torch.cat([rows, rows.new_zeros(1, rows.shape[-1])])


def _bases(means: Tensor) -> tuple[Tensor, Tensor]:
    """Return what the coefficients of z1 and of z2 multiply at the pixels of a tile, in the dtype of the means."""
    offset = torch.arange(TILE, device=means.device, dtype=means.dtype) - (TILE - 1) / 2
    x, y = offset.repeat(TILE), offset.repeat_interleave(TILE)
    ones = torch.ones_like(x)
    return torch.stack([ones, x]), torch.stack([ones, x, y])  # [2, 256], [3, 256]


def _weights(plan: _Plan, batch: _Batch, bases: tuple[Tensor, Tensor], cutoff: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return z1, z2 and the weight, times the membership of the pixel, each [T, G, 256]."""
    k = plan.coefficients[batch.entries]
    z1 = k[..., :2] @ bases[0]
    z2 = k[..., 2:] @ bases[1]
    weight = (z1 * z1).addcmul_(z2, z2).mul_(-0.5).clamp_(min=least_exponent(0.0, k.dtype)).exp_()
    if cutoff > 0.0:
        weight.mul_(weight >= cutoff)
    if batch.mixed:
        assert plan.masks is not None and plan.pairs.mask_rows is not None
        mask_rows = torch.cat([plan.pairs.mask_rows, plan.pairs.mask_rows.new_zeros(1)])[batch.entries]
        weight.mul_(plan.masks[mask_rows])
    return z1, z2, weight


def _padded_colors(plan: _Plan, inputs: SplatInputs) -> Tensor:
    return _padded(colors_of(plan.pairs, inputs)[plan.pairs.gaussian])  # [P + 1, C]


def _render(plan: _Plan, inputs: SplatInputs) -> Tensor:
    colors, bases = _padded_colors(plan, inputs), _bases(inputs.means)
    channels = colors.shape[-1]
    values = colors.new_empty(len(plan.segment_tile), channels, _PIXELS)
    for batch in plan.batches:
        _, _, weight = _weights(plan, batch, bases, inputs.cutoff)
        values[batch.segments] = colors[batch.entries].transpose(1, 2) @ weight
    tile_ids, counts = torch.unique_consecutive(plan.segment_tile, return_counts=True)
    if len(tile_ids) < len(values):
        values = sum_runs(values.flatten(1), counts).unflatten(1, (channels, _PIXELS))
    tiles = colors.new_zeros(plan.pairs.num_tiles, channels, _PIXELS)
    tiles[tile_ids] = values
    tiles, grid = tiles.unflatten(2, (TILE, TILE)), grid_of(inputs)
    if plan.pairs.wide is not None:
        sample(tiles[grid.total :], plan.pairs.wide.nodes, plan.masks, tiles[: grid.total])
    return join_tiles(tiles[: grid.total].unflatten(0, grid), inputs.size)


def _differentiate(plan: _Plan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    grad = split_into_tiles(grad).flatten(0, 2)  # [tiles, C, 16, 16]
    if plan.pairs.wide is not None:
        grad = torch.cat([grad, gather(grad, plan.pairs.wide.nodes, plan.masks)])
    grad = grad.flatten(2)
    colors, bases = _padded_colors(plan, inputs), _bases(inputs.means)
    sums = colors.new_zeros(len(colors), (5 if geometry else 0) + colors.shape[-1])
    for batch in plan.batches:
        z1, z2, weight = _weights(plan, batch, bases, inputs.cutoff)
        local = grad[plan.segment_tile[batch.segments]]
        parts = [weight @ local.transpose(1, 2)]
        if geometry:
            parts.append(_moments(z1, z2, weight.mul_(colors[batch.entries] @ local)))
        sums[batch.entries] = torch.cat(parts, -1)
    counts = torch.bincount(plan.pairs.gaussian, minlength=inputs.means.shape[0] * inputs.means.shape[1])
    return gradients_of(plan.pairs, inputs, sum_runs(sums[:-1], counts))


def _moments(z1: Tensor, z2: Tensor, value: Tensor) -> Tensor:
    """Sum v (z1, z2, z1 z1, z1 z2, z2 z2) over the pixels, [T, G, 5]."""
    first = value * z1
    second = value.mul_(z2)
    mean = torch.stack([first.sum(-1), second.sum(-1)], -1)
    cross = (second * z1).sum(-1)
    return torch.cat([mean, torch.stack([first.mul_(z1).sum(-1), cross, second.mul_(z2).sum(-1)], -1)], -1)
