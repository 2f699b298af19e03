"""What a kernel is: the inputs that every kernel takes, and the steps that it consists of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

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

    def with_batch(self) -> SplatInputs:
        """Return the same, with B where Gaussians of one image have none."""
        if self.means.ndim == 3:
            return self
        return SplatInputs(self.means[None], self.cholesky[None], self.colors[None], *self[3:])


class OutOfRangeError(ValueError):
    """A value is not finite or beyond the limits in whitened.py; the public function says which."""


class Steps(NamedTuple):
    """A kernel in three steps, without a graph.

    `plan(inputs)` finds what touches what, `render(plan, inputs)` gives the image (B, C, H, W), and
    `differentiate(plan, inputs, grad, geometry)` the gradients of means, cholesky (None unless `geometry`) and colors.
    `image(inputs)` renders with a graph of all orders; None: the kernel is differentiable once.
    `as_given`: Gaussians of one image may come without B, which results have not either then, and the plan raises
    OutOfRangeError where values are out of range; else B is there, and values have been checked.
    """

    plan: Callable[[SplatInputs], Any]
    render: Callable[[Any, SplatInputs], Tensor]
    differentiate: Callable[[Any, SplatInputs, Tensor, bool], Gradients]
    image: Callable[[SplatInputs], Tensor] | None = None
    as_given: bool = False


@contextmanager
def with_autograd() -> Iterator[None]:
    """Record a graph inside of an operator, which is evaluated below autograd."""
    keys = torch._C.DispatchKey.AutogradFunctionality, torch._C.DispatchKey.ADInplaceOrView
    with ExitStack() as stack:
        for key in keys:
            stack.enter_context(torch._C._SetExcludeDispatchKeyGuard(key, False))
        stack.enter_context(torch.enable_grad())
        yield
