"""`kcgs::region_splat` in standard operators, by which `torch.onnx.export` replaces it; docs/onnx.md describes both.

Three loops bound the memory, and no shape depends on values: over tiles, over the regions in the window of a tile, and
over chunks of the Gaussians of a region that reach the tile. Bodies of loops are handed all tensors that they read.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs.kernels import least_exponent, least_whitened, support_radius, whiten

from .arguments import SplatArguments
from .map_windows import MapWindows

_SIDE = 32  # pixels of a tile
_CHUNK = 64  # Gaussians evaluated at once
_FRAME = 5  # numbers of a Gaussian before its colour: mean x, mean y, 1 / l11, l21 / l11, 1 / l22


class _TileGaussians(NamedTuple):
    """The Gaussians of an image, and the tile at which they are evaluated."""

    first: Tensor  # [] int64, row of the image's first Gaussian
    num_gaussians: Tensor  # [] int64, N; the row after the last Gaussian has no colour
    middle: Tensor  # [2] x and y of the middle of the tile
    rows: Tensor  # [B (N + 1), 5 + C] frames and colours


def decompose(*operands: Any) -> Tensor:
    """Render as `kcgs::region_splat` does, from its arguments; this is to be traced, and slow in eager mode."""
    arguments = SplatArguments.of(*operands)
    if arguments.means.ndim == 2:
        return decompose(*(None if t is None else t[None] for t in operands[:4]), *operands[4:]).squeeze(0)
    # the graph only renders: not all of its loops can be differentiated
    means, cholesky, colors = (t.detach() for t in arguments[:3])
    device, (batch, count, channels), (height, width) = means.device, colors.shape, arguments.size
    l11, l21, l22 = cholesky.unbind(-1)
    frame = torch.stack([*means.unbind(-1), 1 / l11, l21 / l11, 1 / l22], -1)
    # one more Gaussian, without colour and region
    rows = torch.nn.functional.pad(torch.cat([frame, colors], -1), (0, 0, 0, 1))
    ids = torch.zeros_like(means[..., 0], dtype=torch.int64) if arguments.region_ids is None else arguments.region_ids
    ids = torch.nn.functional.pad(ids, (0, 1), value=-1)

    # not -(-height // _SIDE): division of integers rounds to zero in ONNX
    down, across = (height + _SIDE - 1) // _SIDE, (width + _SIDE - 1) // _SIDE
    counts = torch.stack([torch.full((), n, dtype=torch.int64, device=device) for n in (down, across, count)])
    table = arguments.table
    windows = None if table is None else MapWindows(table, arguments.size, _SIDE, means.dtype)

    def render_tile(carry: Tensor, number: Tensor, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        (down, across, count), columns, rows, ids = tensors[0].unbind(), *tensors[1:4]
        column, row, image = number % across, number // across % down, number // (across * down)
        middle = torch.stack([column, row]).to(rows.dtype) * _SIDE + _SIDE / 2
        near = _mark_near(columns.index_select(0, image.reshape(1)).squeeze(0), middle, arguments.cutoff)
        black = rows.new_zeros(rows.shape[1] - _FRAME, _SIDE * _SIDE)
        gaussians = _TileGaussians(image * (count + 1), count, middle, rows)
        if windows is None:
            total = _sum_gaussians(near, gaussians, black, arguments.cutoff)
        else:
            ids = ids.index_select(0, image.reshape(1)).squeeze(0)
            window = windows.read_tile(tensors[4:], image, row, column)
            total = _sum_regions(windows, window, near, ids, gaussians, black, arguments.cutoff)
        return carry + 1, total.reshape(-1, _SIDE, _SIDE)

    numbers = torch.arange(batch * down * across, device=device)
    tensors: tuple[Tensor, ...] = (counts, rows[..., :_FRAME].transpose(1, 2).contiguous(), rows.flatten(0, 1), ids)
    if windows is not None:
        tensors = (*tensors, *windows.tables)
    _, tiles = torch.ops.higher_order.scan(render_tile, [torch.zeros_like(counts[0])], [numbers], tensors)
    image = tiles.reshape(batch, down, across, channels, _SIDE, _SIDE).permute(0, 3, 1, 4, 2, 5)
    image = image.reshape(batch, channels, down * _SIDE, across * _SIDE)
    # crop by a negative pad, which keeps shapes plain: a slice would have min(height, rows) rows
    return torch.nn.functional.pad(image, (0, width - across * _SIDE, 0, height - down * _SIDE)).contiguous()


def _mark_near(columns: Tensor, middle: Tensor, cutoff: float) -> Tensor:
    """Mark the Gaussians whose support reaches a tile, [N + 1]; the last row is no Gaussian and is not marked."""
    x, y, inverse1, slope, inverse2 = columns.unbind()
    radius = support_radius(cutoff, x.dtype)
    z1, z2 = least_whitened(middle[0] - x, middle[1] - y, inverse1, slope, inverse2, _SIDE / 2)
    return (z1 <= radius) & (z2 <= radius) & (inverse1 > 0)


def _sum_regions(
    windows: MapWindows,
    window: tuple[Tensor, ...],
    near: Tensor,
    ids: Tensor,
    gaussians: _TileGaussians,
    black: Tensor,
    cutoff: float,
) -> Tensor:
    """Add up the regions of a tile, in the order of their ids; `window` begins with the sorted ids."""

    def has_region(place: Tensor, total: Tensor, weight: Tensor, *tensors: Tensor) -> Tensor:
        return place < tensors[6].shape[0]

    def add_region(place: Tensor, total: Tensor, weight: Tensor, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        near, ids, gaussians, window_ids, operands = *tensors[:2], tensors[2:6], tensors[6], tensors[7:]
        region = window_ids.index_select(0, place.reshape(1))
        image = _sum_gaussians(near & (ids == region), _TileGaussians(*gaussians), torch.zeros_like(total), cutoff)
        membership = windows.membership(operands, region).reshape(1, -1)
        return (window_ids <= region).sum(), total + image * membership, weight + membership

    start = torch.zeros_like(gaussians.num_gaussians), black, torch.zeros_like(black[:1])
    loop = torch.ops.higher_order.while_loop
    _, total, weight = loop(has_region, add_region, start, (near, ids, *gaussians, *window))
    image: Tensor = total / weight if windows.is_resized else total
    return image


def _sum_gaussians(near: Tensor, gaussians: _TileGaussians, black: Tensor, cutoff: float) -> Tensor:
    """Add up colour times weight over the Gaussians that are marked, [C, pixels]."""

    def has_chunk(start: Tensor, total: Tensor, stop: Tensor, *tensors: Tensor) -> Tensor:
        return start < stop

    def add_chunk(start: Tensor, total: Tensor, stop: Tensor, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        order, (first, count, middle, rows) = tensors[0], tensors[1:]
        places = start + torch.arange(_CHUNK, device=rows.device)
        numbers = torch.where(places < stop, order.index_select(0, torch.minimum(places, count)), count)
        chunk = rows.index_select(0, first + numbers)
        return start + _CHUNK, total + chunk[:, _FRAME:].T @ _weights(chunk[:, :_FRAME], middle, cutoff)

    order = torch.sort(near.to(torch.int32), descending=True)[1]
    start = torch.zeros_like(order[0]), black
    total: Tensor = torch.ops.higher_order.while_loop(has_chunk, add_chunk, start, (near.sum(), order, *gaussians))[1]
    return total


def _weights(frame: Tensor, middle: Tensor, cutoff: float) -> Tensor:
    """Evaluate the weights of K Gaussians at the pixels of a tile, [K, pixels]."""
    offsets = torch.arange(_SIDE, device=frame.device, dtype=frame.dtype) - (_SIDE - 1) / 2
    mean_x, mean_y, inverse1, slope, inverse2 = (v[:, None, None] for v in frame.unbind(1))
    # the mean is subtracted before any product: nothing cancels where a Gaussian is much narrower than a pixel
    x = (middle[0] - mean_x) + offsets  # [K, 1, side]
    y = (middle[1] - mean_y) + offsets[:, None]  # [K, side, 1]
    z1, z2 = whiten(x, y, inverse1, slope, inverse2)
    weight = ((z1 * z1 + z2 * z2) * -0.5).clamp_min(least_exponent(0.0, frame.dtype)).exp()
    if cutoff > 0.0:
        weight = torch.where(weight >= cutoff, weight, 0.0)
    return weight.flatten(1)
