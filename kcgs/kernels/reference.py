"""The oracle: the sum as it is written, dense, in any floating dtype, differentiated by autograd.

One region at a time, in chunks of pixels that are recomputed in the backward, so that memory stays flat.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from .inputs import Gradients, SplatInputs, Steps, with_autograd
from .whitened import Z_LIMIT

_CHUNK_ELEMENTS = 1 << 22


def steps(inputs: SplatInputs) -> Steps:
    """Return the kernel."""
    return Steps(lambda inputs: None, _render, _differentiate, splat)


def _render(plan: None, inputs: SplatInputs) -> Tensor:
    with torch.no_grad():
        return splat(inputs)


def _differentiate(plan: None, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    wanted = slice(0 if geometry else 2, 3)
    with with_autograd():
        gaussians = [t.detach() for t in inputs[:3]]
        leaves = [t.requires_grad_() for t in gaussians[wanted]]
        image = splat(inputs._replace(means=gaussians[0], cholesky=gaussians[1], colors=gaussians[2]))
        found = torch.autograd.grad(image, leaves, grad)
    return (found[0], found[1], found[2]) if geometry else (None, None, found[0])


def splat(inputs: SplatInputs) -> Tensor:
    """Render (B, C, H, W), with a graph."""
    height, width = inputs.size
    batch, _, channels = inputs.colors.shape
    image = inputs.colors.new_zeros(batch, height * width, channels)
    # part of the graph, even if there is nothing to render
    image = image + sum((0.0 * t).sum() for t in inputs[:3])
    for b in range(batch):
        for chosen, weights in _regions(inputs, b):
            if weights is None:
                pixels = torch.arange(height * width, device=inputs.means.device)
            else:
                pixels = weights.nonzero().flatten()
                weights = weights[pixels]
            means, cholesky, colors = (t[b, chosen] for t in inputs[:3])
            image[b].index_add_(0, pixels, _region_sum(inputs, means, cholesky, colors, pixels, weights))
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


def _region_sum(
    inputs: SplatInputs, means: Tensor, cholesky: Tensor, colors: Tensor, pixels: Tensor, weights: Tensor | None
) -> Tensor:
    """Evaluate Gaussians (N, ...) at flat pixel indices (P,), which gives (P, C)."""
    x, y = ((v.to(means.dtype) + 0.5) for v in (pixels % inputs.size[1], pixels // inputs.size[1]))
    step = max(1, _CHUNK_ELEMENTS // max(1, len(means)))
    if len(pixels) <= step:
        return _dense_sum(x, y, weights, (means, cholesky, colors), inputs.cutoff)
    parts = [slice(k, k + step) for k in range(0, len(pixels), step)]
    points = [(x[p], y[p], None if weights is None else weights[p]) for p in parts]
    total: Tensor = _Chunks.apply(points, inputs.cutoff, means, cholesky, colors)  # type: ignore[no-untyped-call]
    return total


class _Chunks(torch.autograd.Function):
    """`_dense_sum` chunk by chunk, each evaluated again when it is differentiated."""

    @staticmethod
    def forward(ctx: Any, points: list[Any], cutoff: float, *gaussians: Tensor) -> Tensor:
        ctx.points, ctx.cutoff = points, cutoff
        ctx.save_for_backward(*gaussians)
        return torch.cat([_dense_sum(x, y, region, gaussians, cutoff) for x, y, region in points])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        again = torch.is_grad_enabled()
        gaussians = ctx.saved_tensors if again else [t.detach().requires_grad_() for t in ctx.saved_tensors]
        total = [torch.zeros_like(t) for t in gaussians]
        for (x, y, region), part in zip(ctx.points, grad.split([len(p[0]) for p in ctx.points]), strict=True):
            with torch.enable_grad():
                value = _dense_sum(x, y, region, gaussians, ctx.cutoff)
            terms = torch.autograd.grad(value, gaussians, part, create_graph=again)
            total = [t + term for t, term in zip(total, terms, strict=True)]
        return (None, None, *total)


def _dense_sum(x: Tensor, y: Tensor, region: Tensor | None, gaussians: Sequence[Tensor], cutoff: float) -> Tensor:
    means, cholesky, colors = gaussians
    l11, l21, l22 = cholesky.unbind(-1)
    # far beyond any weight that is not zero, and squares stay finite: no inf * 0 in the backward
    z1 = ((x[:, None] - means[:, 0]) / l11).clamp(-Z_LIMIT, Z_LIMIT)  # [P, N]
    z2 = ((y[:, None] - means[:, 1] - l21 * z1) / l22).clamp(-Z_LIMIT, Z_LIMIT)
    weight = torch.exp(-0.5 * (z1 * z1 + z2 * z2))
    weight = torch.where(weight >= cutoff, weight, 0.0)
    value = weight @ colors  # [P, C]
    return value if region is None else value * region[:, None]
