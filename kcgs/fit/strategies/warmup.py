"""Region ids while centres move: the paper's warm-up."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcgs.fit.state import FitState
from kcgs.functional import RegionMap, lookup_regions


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
        iteration, iterations = self.state.iteration, self.state.config.iterations
        if self.state.regions is None or iteration % max(1, round(self.every * iterations)):
            return False
        return 0 < iteration <= self.until * iterations

    def apply(self, state: FitState) -> None:
        """Read the ids."""
        assert state.regions is not None
        state.region_ids = refresh_ids(state.optimizer.gaussians()[0], state.region_ids, state.regions)


def refresh_ids(means: Tensor, region_ids: Tensor | None, regions: RegionMap) -> Tensor:
    """Read the ids again under the centres, but leave no region without its last Gaussian.

    A region that lost every Gaussian would stay black for good, since nothing outside it feels its error.
    """
    found = lookup_regions(means, regions.labels)
    if region_ids is None:
        return found
    left = torch.zeros(regions.num_regions, dtype=torch.bool, device=found.device)
    left[regions.index_of(found)] = True
    return torch.where(left[regions.index_of(region_ids)], found, region_ids)
