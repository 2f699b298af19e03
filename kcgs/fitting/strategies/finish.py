"""The end of a fit: no more drafts, then the best state, pruned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from kcgs.fitting.descent import log, render
from kcgs.fitting.region_report import report_regions
from kcgs.fitting.state import FitResult, FitState, StopReason
from kcgs.pruning import prune

from .densify import leave_out


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
            state.best_score = float("-inf")


def finish(state: FitState, reason: StopReason) -> FitResult:
    """Measure the last state, take the best, and remove what it does not need; return a fit that ended for a reason."""
    config = state.config
    drafted = None if state.cutoff == config.cutoff else state.best
    EndDrafts().apply(state)
    with torch.no_grad():
        if drafted is not None:
            log(state, render(state, drafted), drafted)
        if reason != "diverged" and state.optimizer.is_finite():
            leave_out(state, state.count() - state.num_gaussians)
            log(state, render(state))
    assert state.best is not None
    scene = state.best.scene(state.size)
    removed, change = 0, 0.0
    if config.prune > 0:
        scene, removed, change = prune(scene, config.prune, cutoff=config.cutoff, backend=config.backend)
    dropped: Literal["recipe"] | None = None if config.guidance else "recipe"
    regions = report_regions(state.given, scene, dropped=dropped)
    return FitResult(scene, state.history, reason, config, removed, change, regions, state.seconds())
