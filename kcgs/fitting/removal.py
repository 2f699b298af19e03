"""Removal of the Gaussians that cost least."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kcgs.functional import region_splat
from kcgs.functional.weights import weight_sums

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

    The impact of Gaussian i is :math:`|c_i|^2 \langle g_i, g_i \rangle / (1 + \sum_j o_{ij})`, where the overlap
    :math:`o_{ij}` is the normalised inner product of two Gaussians of half the covariances: about the share of the
    energy of one that the other explains, and 1 for twins. The colours of the others take one gradient step of the best
    length towards the render of those that are removed, each by the energy about it.

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
    energy = math.pi * cholesky[:, :1] * cholesky[:, 2:]
    norm = (0.5 * energy).rsqrt()
    total, overlaps = weight_sums(lambda ones: render(means, cholesky / math.sqrt(2.0), norm * ones), colors[:, :1])
    crowding = overlaps(total).clamp_min(1.0)
    impact = weight * colors.square().sum(1) * (energy / crowding)[:, 0]
    removed = torch.zeros_like(impact, dtype=torch.bool)
    removed[impact.argsort(stable=True)[:count]] = True
    lost = render(means, cholesky, colors * removed[:, None])
    products = weight_sums(lambda ones: render(means, cholesky, ones), colors)[1]
    step = products(lost) / (energy * crowding) * ~removed[:, None]
    rendered = render(means, cholesky, step)
    length = (rendered * lost).sum() / rendered.square().sum().clamp_min(torch.finfo(lost.dtype).tiny)
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
