"""Removal of the Gaussians that cost least, in a fit."""

from __future__ import annotations

import torch

from .state import FitState


@torch.no_grad()
def remove_gaussians(state: FitState, count: int) -> None:
    """Remove so many Gaussians, if any, those with the lowest impact; their neighbours get their colours."""
    from .redundancy import lowest_impact  # loads numba

    objective = state.problem.objective
    while count > 0:
        field, regions = state.scene.field, state.scene.regions
        means, cholesky, colors = field.means.detach(), field.cholesky.detach(), field.colors.detach()
        index = torch.zeros(len(means), dtype=torch.int64)
        if regions is not None and field.region_ids is not None:
            index = regions.index_of(field.region_ids)
        weight = torch.ones(len(means)) if objective is None else objective.weigh(means, cholesky)
        removed, new_colors = lowest_impact(
            means.cpu().numpy(), cholesky.cpu().numpy(), colors.cpu().numpy(), index.cpu().numpy(), count,
            weight.cpu().numpy(),
        )  # fmt: skip
        colors.copy_(torch.from_numpy(new_colors))
        state.optimizer.keep(field, torch.from_numpy(~removed).to(means.device))
        count -= int(removed.sum())
