"""Sums over pixels, by the weights of each Gaussian."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from kcgs.maps import RegionMap

from .splat import squared_error_gradients


@torch.enable_grad()
def weighted_sums(render: Callable[[Tensor], Tensor], colors: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return a render, (C, H, W), and a function that sums an image over the weights of each Gaussian, (N, C).

    Args:
        render: of the Gaussians in any colours, (N, C).
        colors: those of the render, (N, C).
    """
    leaf = colors.detach().requires_grad_()
    image = render(leaf)
    # the render is linear in the colours, so its gradient by them has the sums
    return image.detach(), lambda values: torch.autograd.grad(image, leaf, values, retain_graph=True)[0]


def inner_products(
    means: Tensor,
    cholesky: Tensor,
    colors: Tensor,
    region_ids: Tensor | None,
    regions: RegionMap | None,
    *,
    size: tuple[int, int],
    cutoff: float,
    backend: str,
) -> Tensor:
    """Return the sums of the render over the weights of each Gaussian, (N, C), in one pass where the backend has it."""
    # the render, less nothing, is what the squared error of a black image is differentiated by
    black = colors.new_zeros(colors.shape[1], *size)
    arguments = means, cholesky, colors, region_ids, regions
    return squared_error_gradients(black, *arguments, cutoff=cutoff, backend=backend)[2]
