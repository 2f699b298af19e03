"""The weights of each Gaussian, summed over pixels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


@torch.enable_grad()
def weight_sums(render: Callable[[Tensor], Tensor], colors: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return the sum of all weights at each pixel, (C, H, W), and a function that sums such maps per Gaussian.

    The function weighs each pixel by the weight of the Gaussian there and returns (N, C).

    Args:
        render: of Gaussians in other colours, (N, C).
        colors: of the Gaussians, for its shape, (N, C).
    """
    ones = torch.ones_like(colors).requires_grad_()
    total = render(ones)
    # the render is linear in the colours, so its gradient by them has the sums
    return total.detach(), lambda values: torch.autograd.grad(total, ones, values, retain_graph=True)[0]
