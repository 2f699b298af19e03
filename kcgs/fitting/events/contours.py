"""Contours that follow the image while Gaussians are added, and after that."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kcgs.fitting.contour_moves import move_contours
from kcgs.fitting.state import FitState
from kcgs.functional import RegionMap, choose_softness


@dataclass(frozen=True)
class AdaptContours:
    """Move the contours before some of the additions of Gaussians, which then adapt to the new contours.

    The event `Densify` does this.
    """

    max_rise: float = 1.5
    """Factor by which a move may raise the squared error about it."""
    additions_per_move: int = 2
    """Contours move before every second addition."""
    additions_per_softness: int = 4
    """Before every fourth addition their softness is chosen anew, where the settings ask for it."""

    def adapt(self, state: FitState) -> None:
        """Move the contours, and at times choose their softness, if that is due before this addition."""
        if state.num_additions % self.additions_per_move:
            return
        _move_contours(state, self.max_rise)
        regions, problem = state.regions, state.problem
        is_turn = state.num_additions % self.additions_per_softness == self.additions_per_move
        if regions is not None and problem.chooses_softness and is_turn:
            labels = regions.labels.cpu()
            chosen = RegionMap.from_labels(labels, choose_softness(problem.canvas, labels))
            state.regions = chosen.to(problem.device)


def _move_contours(state: FitState, max_rise: float) -> None:
    """Move the contours where that raises the squared error about them by no more than a factor."""
    image, config = state.problem.image, state.problem.config
    if state.regions is None or state.anchor is None or image is None:
        return
    state.regions = move_contours(state.gaussians, state.renderer, image, state.anchor.labels, config, max_rise)


@dataclass(frozen=True)
class SettleContours:
    """Move the contours a few times after densification, where that lowers the error at once."""

    after: float
    """Share of the fit at the end of densification."""
    num_moves: int = 4
    """How often contours move, evenly over the rest of the fit."""

    @torch.no_grad()
    def act(self, state: FitState) -> None:
        """Move the contours, if it is time to."""
        move = state.num_late_moves + 1
        time = self.after + (1 - self.after) * move / (self.num_moves + 1)
        if move <= self.num_moves and state.progress >= time:
            state.num_late_moves = move
            _move_contours(state, max_rise=1.0)
