"""The change from the cutoff of a draft to that of the result."""

from __future__ import annotations

from dataclasses import dataclass

from kcgs.fitting.state import FitState


@dataclass(frozen=True)
class EndDrafts:
    """Render with the cutoff of the result after a share of the fit."""

    after: float = 0.85
    """Share of the fit that renders with the draft cutoff."""

    def act(self, state: FitState) -> None:
        """Set the cutoff, once."""
        if state.is_draft and state.progress >= self.after:
            state.end_drafts()
