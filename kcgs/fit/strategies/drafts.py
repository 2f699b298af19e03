"""The first part of a fit renders drafts, which are faster."""

from __future__ import annotations

from dataclasses import dataclass

from kcgs.fit.state import FitState


@dataclass(frozen=True)
class EndDrafts:
    """Render with the cutoff of the result from here on."""

    after: float = 0.85
    """Share of the fit that renders with the draft cutoff."""

    def due(self, progress: float) -> bool:
        """Say whether drafts have served their time."""
        return progress >= self.after

    def apply(self, state: FitState) -> None:
        """Sharpen; the next state that is measured is the best, for what was measured on drafts does not compare."""
        if state.cutoff != state.config.cutoff:
            state.cutoff = state.config.cutoff
            state.best_psnr = float("-inf")
