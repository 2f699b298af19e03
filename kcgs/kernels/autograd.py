"""What a kernel is: the inputs that every kernel takes, and the autograd function of those with their own backward."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .membership import Membership

Gradients = tuple[Tensor | None, Tensor | None, Tensor]


class SplatInputs(NamedTuple):
    """Arguments of one splat, checked and batched by the public function.

    Floating tensors share one dtype (float32 or float64) and one device.
    """

    means: Tensor  # [B, N, 2] pixels
    cholesky: Tensor  # [B, N, 3] pixels
    colors: Tensor  # [B, N, C]
    region_index: Tensor | None  # [B, N] int64, position in the sorted list of regions; -1: not in the map
    membership: Membership | None  # None: one region covers everything
    size: tuple[int, int]  # (height, width)
    cutoff: float


class Steps(NamedTuple):
    """A kernel in three steps.

    `plan(inputs)` finds what touches what, `render(plan, inputs)` gives the image (B, C, H, W), and
    `differentiate(plan, inputs, grad, geometry)` the gradients of means, cholesky (None unless `geometry`) and colors.
    """

    plan: Callable[[SplatInputs], Any]
    render: Callable[[Any, SplatInputs], Tensor]
    differentiate: Callable[[Any, SplatInputs, Tensor, bool], Gradients]


def apply_kernel(steps: Steps, inputs: SplatInputs) -> Tensor:
    """Render with gradients where they are asked for, and without a trace where they are not."""
    if not torch.is_grad_enabled() or not any(t.requires_grad for t in inputs[:3]):
        return steps.render(steps.plan(inputs), inputs)
    image: Tensor = _Splat.apply(inputs.means, inputs.cholesky, inputs.colors, inputs, steps)  # type: ignore[no-untyped-call]
    return image


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, cholesky: Tensor, colors: Tensor, inputs: SplatInputs, steps: Steps) -> Tensor:
        plan = steps.plan(inputs)
        ctx.save_for_backward(means, cholesky, colors)
        ctx.plan, ctx.steps, ctx.settings = plan, steps, inputs[3:]
        return steps.render(plan, inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        inputs = SplatInputs(*ctx.saved_tensors, *ctx.settings)
        geometry = ctx.needs_input_grad[0] or ctx.needs_input_grad[1]
        gradients = ctx.steps.differentiate(ctx.plan, inputs, grad, geometry)
        wanted = zip(gradients, ctx.needs_input_grad, strict=False)
        return (*(g if need else None for g, need in wanted), None, None)
