"""Region ids while centres move: the paper's warm-up."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kcgs.fitting.state import FitState
from kcgs.functional import lookup_regions


@dataclass(frozen=True)
class RefreshIds:
    """Read the region ids again under the moving centres."""

    state: FitState
    every: float = 0.02
    """Share of the iterations between refreshes."""
    until: float = 0.5
    """Share of the iterations after which the ids are frozen."""

    def due(self, progress: float) -> bool:
        """Say whether it is time; by iterations, as the paper has it."""
        iteration, iterations = self.state.iteration, self.state.config.usual_iterations
        if self.state.regions is None or iteration % max(1, round(self.every * iterations)):
            return False
        return 0 < iteration <= self.until * iterations

    def apply(self, state: FitState) -> None:
        """Read the ids, but leave no region without its last Gaussian: nothing outside it would feel its error."""
        regions, ids = state.regions, state.region_ids
        assert regions is not None and ids is not None
        found = lookup_regions(state.optimizer.gaussians()[0], regions.labels)
        left = torch.zeros(regions.num_regions, dtype=torch.bool, device=found.device)
        left[regions.index_of(found)] = True
        state.region_ids = torch.where(left[regions.index_of(ids)], found, ids)
