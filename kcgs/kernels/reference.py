"""The oracle: the sum as it is written, dense, in any floating dtype, differentiated by autograd.

One region at a time, in chunks of pixels that are recomputed in the backward, so that memory stays flat.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from .form import Z_LIMIT
from .inputs import SplatInputs

_CHUNK_ELEMENTS = 1 << 22


def splat(inputs: SplatInputs) -> Tensor:
    """Render (B, C, H, W)."""
    height, width = inputs.size
    batch, _, channels = inputs.colors.shape
    image = inputs.colors.new_zeros(batch, height * width, channels)
    # part of the graph, even if nothing is drawn
    image = image + sum((0.0 * t).sum() for t in inputs[:3])
    for b in range(batch):
        for chosen, weights in _regions(inputs, b):
            pixels = weights.nonzero().flatten() if weights is not None else None
            _add_region(image[b], inputs, b, chosen, pixels, weights)
    return image.transpose(1, 2).reshape(batch, channels, height, width)


def _regions(inputs: SplatInputs, b: int) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Yield (Gaussians of a region, its pixel weights (H * W,) or None for one everywhere)."""
    membership, index = inputs.membership, inputs.region_index
    if membership is None or index is None:
        yield torch.arange(inputs.means.shape[1], device=inputs.means.device), None
        return
    map_of = b if membership.index.shape[0] > 1 else 0
    for region in range(membership.num_regions):
        chosen = (index[b] == region).nonzero().flatten()
        if len(chosen):
            yield chosen, membership.weights(map_of, region, inputs.means.dtype).flatten()


def _add_region(
    image: Tensor, inputs: SplatInputs, b: int, chosen: Tensor, pixels: Tensor | None, weights: Tensor | None
) -> None:
    if pixels is None:
        pixels = torch.arange(image.shape[0], device=image.device)
    means, cholesky, colors = (t[b, chosen] for t in (inputs.means, inputs.cholesky, inputs.colors))
    step = max(1, _CHUNK_ELEMENTS // max(1, len(chosen)))
    for part in pixels.split(step):
        share = None if weights is None else weights[part]
        x = (part % inputs.size[1]).to(means.dtype) + 0.5
        y = (part // inputs.size[1]).to(means.dtype) + 0.5
        arguments = (x, y, means, cholesky, colors, share, inputs.cutoff)
        if torch.is_grad_enabled():
            value = checkpoint(_dense_sum, *arguments, use_reentrant=False, preserve_rng_state=False)
        else:
            value = _dense_sum(*arguments)
        image.index_add_(0, part, value)


def _dense_sum(
    x: Tensor, y: Tensor, means: Tensor, cholesky: Tensor, colors: Tensor, share: Tensor | None, cutoff: float
) -> Tensor:
    l11, l21, l22 = cholesky.unbind(-1)
    # far beyond any weight that is not zero, and squares stay finite: no inf * 0 in the backward
    z1 = ((x[:, None] - means[:, 0]) / l11).clamp(-Z_LIMIT, Z_LIMIT)  # [P, N]
    z2 = ((y[:, None] - means[:, 1] - l21 * z1) / l22).clamp(-Z_LIMIT, Z_LIMIT)
    weight = torch.exp(-0.5 * (z1 * z1 + z2 * z2))
    weight = torch.where(weight >= cutoff, weight, 0.0)
    value = weight @ colors  # [P, C]
    return value if share is None else value * share[:, None]
