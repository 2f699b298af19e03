"""The paper's warm-up: region ids that follow the moving centres."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kcgs.fitting.state import FitState
from kcgs.maps import lookup_regions


@dataclass(frozen=True)
class Warmup:
    """Look up the region ids under the moving centres again, as in the paper; counted in iterations, not in time."""

    every: float = 0.02
    """Share of the iterations between refreshes."""
    until: float = 0.5
    """Share of the iterations after which the ids are frozen."""

    def act(self, state: FitState) -> None:
        """Look up the ids, but empty no region: without a Gaussian, its error would have no gradient."""
        field, regions, iterations = state.field, state.regions, state.problem.config.planned_iterations
        is_turn = state.iteration % max(1, round(self.every * iterations)) == 0
        if regions is None or not is_turn or not 0 < state.iteration <= self.until * iterations:
            return
        assert field.region_ids is not None
        ids = lookup_regions(field.means, regions.labels)
        occupied = torch.zeros(len(ids), regions.num_regions, dtype=torch.bool, device=ids.device)
        occupied.scatter_(1, regions.index_of(ids), True)
        is_free = occupied.gather(1, regions.index_of(field.region_ids))
        field.region_ids = torch.where(is_free, ids, field.region_ids)
