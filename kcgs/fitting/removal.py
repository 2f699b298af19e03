"""Removal of the Gaussians that cost least."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kcgs.functional.weights import inner_products

from .descent import DRAFT_CUTOFF
from .state import FitState


@torch.no_grad()
def lowest_impact(
    products: Callable[[Tensor, Tensor], Tensor],
    cholesky: Tensor,
    colors: Tensor,
    count: int,
    weight: Tensor,
) -> tuple[Tensor, Tensor]:
    r"""Choose Gaussians to remove, and give their colours to the others.

    The impact of Gaussian i is :math:`|c_i|^2 \langle g_i, g_i \rangle / (1 + \sum_j o_{ij})`. The overlap
    :math:`o_{ij}` is the normalised inner product of two Gaussians of half the covariances: 1 for twins, and near 0 for
    distant ones. Only the half of the Gaussians with more energy count as j, for others may be removed as well. The
    other colours take one gradient step towards the render of what is removed, scaled by each one's energy and
    overlaps, and of the best length.

    Args:
        products: from cholesky and colors to the inner products of the Gaussians and their render, (N, C).
        cholesky: (N, 3).
        colors: (N, C).
        count: how many to remove.
        weight: (N,), the weight of the squared error about each one.

    Returns:
        A mask of those to remove, (N,), and the colours of all, (N, C).
    """
    area = math.pi * cholesky[:, :1] * cholesky[:, 2:]
    energy = weight * colors.square().sum(1) * area[:, 0]
    is_strong = torch.ones_like(energy, dtype=torch.bool)
    is_strong[energy.argsort(stable=True)[: len(energy) // 2]] = False
    norm, factors = (0.5 * area).rsqrt(), is_strong[:, None].to(colors)
    overlaps = norm * products(cholesky / math.sqrt(2.0), norm * factors)
    crowding = 1.0 + (overlaps - factors).clamp_min(0.0)
    removed = torch.zeros_like(is_strong)
    removed[(energy / crowding[:, 0]).argsort(stable=True)[:count]] = True
    removed_products = products(cholesky, colors * removed[:, None])
    step = removed_products / (area * crowding) * ~removed[:, None]
    # inner products of the step's render, with what is removed and with itself
    tiny = torch.finfo(step.dtype).tiny
    length = (step * removed_products).sum() / (step * products(cholesky, step)).sum().clamp_min(tiny)
    return removed, colors + length * step


@torch.no_grad()
def remove_gaussians(state: FitState, count: int) -> None:
    """Remove so many Gaussians, if any, those with the lowest impact."""
    if count <= 0:
        return
    field, problem = state.scene.field, state.problem
    means, cholesky, colors = field.means.detach(), field.cholesky.detach(), field.colors.detach()

    def products(cholesky: Tensor, colors: Tensor) -> Tensor:
        return inner_products(
            means, cholesky, colors, field.region_ids, state.scene.regions,
            size=problem.size, cutoff=DRAFT_CUTOFF, backend=problem.config.backend,
        )  # fmt: skip

    weight = torch.ones_like(means[:, 0]) if problem.objective is None else problem.objective.weigh(means, cholesky)
    removed, new_colors = lowest_impact(products, cholesky, colors, count, weight)
    colors.copy_(new_colors)
    state.optimizer.keep(field, ~removed)
