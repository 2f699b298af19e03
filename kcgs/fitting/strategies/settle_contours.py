"""Contours that follow the image after Gaussians were added."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kcgs.fitting.adapt_contours import move_contours_of
from kcgs.fitting.state import FitState


@dataclass(frozen=True)
class SettleContours:
    """Move the contours a few times after densification, where that lowers the error at once."""

    after: float
    """Share of the fit at the end of densification."""
    num_moves: int = 4
    """How often contours move, evenly over the rest of the fit."""

    def due(self, state: FitState) -> bool:
        """True at the time of the next move."""
        move = state.num_late_moves + 1
        share = self.after + (1 - self.after) * move / (self.num_moves + 1)
        return move <= self.num_moves and state.progress >= share

    @torch.no_grad()
    def apply(self, state: FitState) -> None:
        """Move the contours."""
        state.num_late_moves += 1
        move_contours_of(state, max_rise=1.0)
