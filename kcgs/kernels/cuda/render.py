"""The image, or its error: a program sums the pairs of a tile at its 256 pixels."""

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..interface import SplatInputs
from ..whitened import least_exponent
from .plan import SIDE, CudaPlan, fails
from .triton_function import triton_function

# channels that a thread holds at once, in registers
_MAX_CHANNELS = 4
# pairs whose loads are under way at once
_UNROLL = tl.constexpr(4)
# a smaller weight is 0
_LEAST_WEIGHT = math.exp(least_exponent(0.0, torch.float32))


def render(plan: CudaPlan, inputs: SplatInputs, target: Tensor | None = None) -> Tensor:
    """Render (B, C, H, W), without B where the Gaussians have none, minus the target where there is one."""
    grid, channels, (height, width) = plan.grid, inputs.colors.shape[-1], inputs.size
    image = torch.empty(
        *inputs.colors.shape[:-2], channels, height, width, dtype=torch.float32, device=inputs.colors.device
    )
    block = channels_at_once(channels)
    with torch.cuda.device_of(image):
        _render(
            (grid.total, -(-channels // block)),
            image, None if target is None else target.contiguous(), inputs.colors.contiguous(), *lists_of(plan, inputs),
            height, width, channels, BLOCK=block, MAPPED=plan.weights is not None, MINUS=target is not None,
        )  # fmt: skip
    return image


def lists_of(plan: CudaPlan, inputs: SplatInputs) -> tuple[Any, ...]:
    """Return the arguments that `_render` and `_gather` share."""
    grid, arrays = plan.grid, (plan.counters, plan.lists, plan.slots, plan.coefficients, plan.weights)
    return *arrays, plan.room, plan.num_cells, grid.total, grid.rows, grid.cols, max(inputs.cutoff, _LEAST_WEIGHT)


def channels_at_once(channels: int) -> int:
    """Return the number of channels that a program evaluates at once."""
    return min(_MAX_CHANNELS, channels)


@triton.jit
def weigh(k0, k1, k2, k3, k4, x, y, cutoff):
    """Evaluate whitened coordinates times SCALE, and the weight."""
    z1 = k0 + k1 * x
    z2 = k2 + k4 * y + k3 * x
    weight = tl.exp2(-(z1 * z1 + z2 * z2))
    return z1, z2, tl.where(weight >= cutoff, weight, 0.0)


@triton_function(warps=2)
def _render(
    image, target, colors, counters, lists, slots, coefficients, weights,
    room, num_cells, num_tiles, rows, cols, cutoff, height, width, channels,
    BLOCK: tl.constexpr, MAPPED: tl.constexpr, MINUS: tl.constexpr,
):  # fmt: skip
    tile, room = tl.program_id(0), room.to(tl.int64)
    pixel = tl.arange(0, SIDE * SIDE)
    across, down = pixel % SIDE, pixel // SIDE
    x, y = across - (SIDE - 1) / 2, down - (SIDE - 1) / 2
    base = tl.program_id(1) * BLOCK
    value = ()
    for _channel in tl.static_range(BLOCK):
        value += (tl.zeros([SIDE * SIDE], tl.float32),)  # type: ignore[assignment]
    first = tl.load(lists + num_cells + tile)
    count = tl.load(lists + 2 * num_cells + num_tiles + tile)
    k = coefficients + first.to(tl.int64) * 5
    for pair in tl.range(first, first + count, loop_unroll_factor=_UNROLL):
        _, _, weight = weigh(tl.load(k), tl.load(k + 1), tl.load(k + 2), tl.load(k + 3), tl.load(k + 4), x, y, cutoff)
        if MAPPED:
            # negative where the region is alone in its tile
            place = tl.load(slots + 2 * room + pair).to(tl.int64) * (SIDE * SIDE) + pixel
            weight *= tl.load(weights + place, mask=place >= 0, other=1.0)
        color = colors + tl.load(slots + room + pair).to(tl.int64) * channels + base
        added = ()
        for c in tl.static_range(BLOCK):
            added += (value[c] + tl.load(color + c, mask=base + c < channels, other=0.0) * weight,)  # type: ignore[assignment]
        value = added
        k += 5

    row, column = tile // cols % rows * SIDE + down, tile % cols * SIDE + across
    plane = (tile // (rows * cols)).to(tl.int64) * channels + base
    failed = fails(counters, room)
    for c in tl.static_range(BLOCK):
        place = ((plane + c) * height + row) * width + column
        inside = (row < tl.where(base + c < channels, height, 0)) & (column < width)
        result = value[c]  # type: ignore[var-annotated]
        if MINUS:
            result -= tl.load(target + place, mask=inside, other=0.0)
        tl.store(image + place, tl.where(failed, float("nan"), result), mask=inside)
