"""The change from the cutoff of a draft to that of the result."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kcgs.fitting.log import take_up
from kcgs.fitting.state import FitState


@dataclass(frozen=True)
class EndDrafts:
    """Render with the cutoff of the result from here on."""

    after: float = 0.85
    """Share of the fit that renders with the draft cutoff."""

    def due(self, state: FitState) -> bool:
        """True once, when drafts are over."""
        return state.progress >= self.after and state.cutoff != state.problem.config.cutoff

    def apply(self, state: FitState) -> None:
        """Set the cutoff; the next state that is measured is the best, since drafts do not compare with it."""
        if state.cutoff != state.problem.config.cutoff:
            take_up(state, wait=True)
            state.cutoff, state.best_score = state.problem.config.cutoff, -math.inf
