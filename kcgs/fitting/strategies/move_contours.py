"""Contours follow the image while the Gaussians do."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kcgs.fitting.contour_moves import accept_moves, refine_contours
from kcgs.fitting.descent import squared_error
from kcgs.fitting.state import FitState
from kcgs.functional import RegionMap, choose_widths


@dataclass(frozen=True)
class MoveContours:
    """Move the contours where that explains the image better.

    Before some of the additions a move may raise the squared error about it, for the Gaussians adapt to it; see
    :class:`Densify`. Later it must lower it: that is when this strategy is due.
    """

    state: FitState
    after: float
    """Share of the fit after which moves must lower the error: the end of densification."""
    rise: float = 1.5
    """Factor by which a move may raise the squared error about it while Gaussians are added."""
    times: int = 4
    """How often contours move then, evenly over the rest."""
    additions_per_move: int = 2
    """Contours move before every second addition."""
    additions_per_choice: int = 4
    """Before every fourth addition their widths are chosen anew."""

    def due(self, progress: float) -> bool:
        """Say whether it is time for a move that must lower the error."""
        moves = self.state.late_moves
        return moves < self.times and progress >= self.after + (1 - self.after) * (moves + 1) / (self.times + 1)

    def apply(self, state: FitState) -> None:
        """Move the contours where that lowers the error at once."""
        state.late_moves += 1
        self.move(state, 1.0)

    def before_addition(self, state: FitState) -> None:
        """Move the contours, and choose their widths, before those additions that it is due before."""
        if state.densifications % self.additions_per_move == 0:
            choose = state.densifications % self.additions_per_choice == self.additions_per_move
            self.move(state, self.rise, choose and state.chooses_widths)

    @torch.no_grad()
    def move(self, state: FitState, rise: float, choose_anew: bool = False) -> None:
        """Move the contours where that raises the squared error about them by no more than this factor."""
        config, before = state.config, state.regions
        if before is None:
            return
        moved = refine_contours(
            state.gaussians().scene(state.size), state.image, given=state.anchor,
            max_distance=None if config.max_move == "any" else config.max_move, length_weight=config.contour_cost,
            backend=config.backend,
        )  # fmt: skip
        if moved is not before:
            gain = rise * squared_error(state) - squared_error(state, state.gaussians()._replace(regions=moved))
            moved = accept_moves(before, moved, gain)
        if choose_anew:
            moved = RegionMap.from_labels(moved.labels, choose_widths(state.image, moved.labels))
        state.regions = moved
