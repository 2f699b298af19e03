"""The paper's warm-up: region ids that follow the moving centres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from kcgs.fitting.state import FitState
from kcgs.functional import lookup_regions


@dataclass(frozen=True)
class Warmup:
    """Read the region ids again under the moving centres, as the paper does; by iterations, whatever the clock says."""

    every: float = 0.02
    """Share of the iterations between refreshes."""
    until: float = 0.5
    """Share of the iterations after which the ids are frozen."""

    def due(self, state: FitState) -> float:
        """Return the progress at the next refresh, if no clock runs ahead of the iterations."""
        is_over = state.regions is None or state.iteration > self._last(state)
        return math.inf if is_over else state.next_multiple(self._interval(state))

    def _last(self, state: FitState) -> float:
        return self.until * state.problem.config.num_iterations

    def _interval(self, state: FitState) -> int:
        return max(1, round(self.every * state.problem.config.num_iterations))

    def act(self, state: FitState) -> None:
        """Read the ids, but leave no region without its last Gaussian: nothing else would feel the error there."""
        if state.iteration % self._interval(state) or not 0 < state.iteration <= self._last(state):
            return
        field, regions = state.field, state.regions
        assert regions is not None and field.region_ids is not None
        ids = lookup_regions(field.means, regions.labels)
        occupied = torch.zeros(regions.num_regions, dtype=torch.bool, device=ids.device)
        occupied[regions.index_of(ids)] = True
        field.region_ids = torch.where(occupied[regions.index_of(field.region_ids)], ids, field.region_ids)
