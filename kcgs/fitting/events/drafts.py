"""The change from the cutoff of a draft to that of the result."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kcgs.fitting.state import FitState

from .log import collect_measurements


@dataclass(frozen=True)
class EndDrafts:
    """Render with the cutoff of the result from here on."""

    after: float = 0.85
    """Share of the fit that renders with the draft cutoff."""

    def due(self, state: FitState) -> float:
        """Return the end of drafts, as long as there are drafts."""
        return self.after if state.is_draft else math.inf

    def act(self, state: FitState) -> None:
        """Set the cutoff; the next state that is measured is the best, since drafts do not compare with it."""
        if state.is_draft:
            collect_measurements(state, wait=True)
            state.renderer = state.renderer._replace(cutoff=state.problem.config.cutoff)
            state.best_value = math.inf
