"""The oracle: the dense sum of the formula, in any floating dtype, differentiated by autograd.

It sums one region at a time, in chunks of pixels that are recomputed in the backward, so that memory stays flat.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from kcgs._torch_internals import with_autograd
from kcgs.maps import membership_at

from .interface import Gradients, Kernel, SplatInputs
from .whitened import Z_LIMIT

# weights (pixels times Gaussians) that are evaluated at once: 32 MiB in float64
_CHUNK_WEIGHTS = 1 << 22


def kernel_for(inputs: SplatInputs) -> Kernel:
    """Return the kernel."""
    return Kernel(lambda inputs: (), _render, _differentiate, splat)


def _render(plan: tuple[()], inputs: SplatInputs) -> Tensor:
    with torch.no_grad():
        return splat(inputs)


def _differentiate(plan: tuple[()], inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    means, cholesky, colors = (t.detach() for t in inputs.gaussians)
    leaves = [t.requires_grad_() for t in ((means, cholesky, colors) if geometry else (colors,))]
    with with_autograd():
        image = splat(inputs._replace(means=means, cholesky=cholesky, colors=colors))
        gradients = torch.autograd.grad(image, leaves, grad)
    return (gradients[0], gradients[1], gradients[2]) if geometry else (None, None, gradients[0])


def splat(inputs: SplatInputs) -> Tensor:
    """Render (B, C, H, W), with a graph."""
    height, width = inputs.size
    batch, _, channels = inputs.colors.shape
    image = inputs.colors.new_zeros(batch, height * width, channels)
    # part of the graph, even if there is nothing to render
    image = image + sum((0.0 * t).sum() for t in inputs.gaussians)
    for b in range(batch):
        for members, membership in _regions(inputs, b):
            if membership is None:
                pixels = torch.arange(height * width, device=inputs.means.device)
            else:
                pixels = membership.nonzero().flatten()
                membership = membership[pixels]
            gaussians = [t[b, members] for t in inputs.gaussians]
            image[b].index_add_(0, pixels, _region_sum(inputs, gaussians, pixels, membership))
    return image.transpose(1, 2).reshape(batch, channels, height, width)


def _regions(inputs: SplatInputs, b: int) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Yield the Gaussians of each region of an image, and the membership of its pixels, (H * W,); None: all 1."""
    table, index = inputs.table, inputs.region_positions
    if table is None or index is None:
        yield torch.arange(inputs.means.shape[1], device=inputs.means.device), None
        return
    membership, map_index = membership_at(table, inputs.size), b if table.shape[0] > 1 else 0
    for region in range(table.num_regions):
        members = (index[b] == region).nonzero().flatten()
        if len(members):
            yield members, membership.weights(map_index, region, inputs.means.dtype).flatten()


def _region_sum(inputs: SplatInputs, gaussians: Sequence[Tensor], pixels: Tensor, membership: Tensor | None) -> Tensor:
    """Return the sum of a region's Gaussians, (N, ...) each tensor, at flat pixel indices (P,): (P, C)."""
    means = gaussians[0]
    x, y = ((v.to(means.dtype) + 0.5) for v in (pixels % inputs.size[1], pixels // inputs.size[1]))
    length = max(1, _CHUNK_WEIGHTS // max(1, len(means)))
    if len(pixels) <= length:
        return _dense_sum(x, y, membership, gaussians, inputs.cutoff)
    slices = [slice(k, k + length) for k in range(0, len(pixels), length)]
    chunks = [(x[s], y[s], None if membership is None else membership[s]) for s in slices]
    total: Tensor = _ChunkedSum.apply(chunks, inputs.cutoff, *gaussians)  # type: ignore[no-untyped-call]
    return total


class _ChunkedSum(torch.autograd.Function):
    """`_dense_sum` chunk by chunk, each evaluated again when it is differentiated."""

    @staticmethod
    def forward(ctx: Any, chunks: list[Any], cutoff: float, *gaussians: Tensor) -> Tensor:
        ctx.chunks, ctx.cutoff = chunks, cutoff
        ctx.save_for_backward(*gaussians)
        return torch.cat([_dense_sum(x, y, membership, gaussians, cutoff) for x, y, membership in chunks])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        is_differentiated = torch.is_grad_enabled()
        gaussians = ctx.saved_tensors if is_differentiated else [t.detach().requires_grad_() for t in ctx.saved_tensors]
        total = [torch.zeros_like(t) for t in gaussians]
        for (x, y, membership), part in zip(ctx.chunks, grad.split([len(c[0]) for c in ctx.chunks]), strict=True):
            with torch.enable_grad():
                value = _dense_sum(x, y, membership, gaussians, ctx.cutoff)
            terms = torch.autograd.grad(value, gaussians, part, create_graph=is_differentiated)
            total = [t + term for t, term in zip(total, terms, strict=True)]
        return (None, None, *total)


def _dense_sum(x: Tensor, y: Tensor, membership: Tensor | None, gaussians: Sequence[Tensor], cutoff: float) -> Tensor:
    means, cholesky, colors = gaussians
    l11, l21, l22 = cholesky.unbind(-1)
    # the limit is far beyond every weight that is not zero, and its square is finite: no inf * 0 in the backward
    z1 = ((x[:, None] - means[:, 0]) / l11).clamp(-Z_LIMIT, Z_LIMIT)  # [P, N]
    z2 = ((y[:, None] - means[:, 1] - l21 * z1) / l22).clamp(-Z_LIMIT, Z_LIMIT)
    weight = torch.exp(-0.5 * (z1 * z1 + z2 * z2))
    weight = torch.where(weight >= cutoff, weight, 0.0)
    value = weight @ colors  # [P, C]
    return value if membership is None else value * membership[:, None]
