"""Removal of the Gaussians that cost least."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kcgs.functional import region_splat
from kcgs.functional.weights import weighted_sums

from .descent import DRAFT_CUTOFF
from .state import FitState


@torch.no_grad()
def lowest_impact(
    render: Callable[[Tensor, Tensor, Tensor], Tensor],
    means: Tensor,
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
        render: of the Gaussians in other shapes and colours, from means, cholesky and colors.
        means: (N, 2).
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
    norm = (0.5 * area).rsqrt()

    def render_narrow(factors: Tensor) -> Tensor:
        return render(means, cholesky / math.sqrt(2.0), norm * factors)

    strong, overlaps = weighted_sums(render_narrow, is_strong[:, None].to(colors))
    crowding = 1.0 + (overlaps(strong) - is_strong[:, None].to(colors)).clamp_min(0.0)
    removed = torch.zeros_like(is_strong)
    removed[(energy / crowding[:, 0]).argsort(stable=True)[:count]] = True
    removed_render, products = weighted_sums(lambda colors: render(means, cholesky, colors), colors * removed[:, None])
    step = products(removed_render) / (area * crowding) * ~removed[:, None]
    change = render(means, cholesky, step)
    tiny = torch.finfo(change.dtype).tiny
    length = (change * removed_render).sum() / change.square().sum().clamp_min(tiny)
    return removed, colors + length * step


@torch.no_grad()
def remove_gaussians(state: FitState, count: int) -> None:
    """Remove so many Gaussians, if any, those with the lowest impact."""
    if count <= 0:
        return
    field, problem = state.scene.field, state.problem
    means, cholesky, colors = field.means.detach(), field.cholesky.detach(), field.colors.detach()

    def render(means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
        return region_splat(
            means, cholesky, colors, field.region_ids, state.scene.regions,
            size=problem.size, cutoff=DRAFT_CUTOFF, backend=problem.config.backend,
        )  # fmt: skip

    weight = torch.ones_like(means[:, 0]) if problem.objective is None else problem.objective.weigh(means, cholesky)
    removed, new_colors = lowest_impact(render, means, cholesky, colors, count, weight)
    colors.copy_(new_colors)
    state.optimizer.keep(field, ~removed)
