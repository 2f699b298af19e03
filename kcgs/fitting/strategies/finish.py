"""The end of a fit: no more drafts, then the best state, refined and pruned."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch

from kcgs.fitting.descent import log, render
from kcgs.fitting.levenberg_marquardt import is_flat, levenberg_marquardt
from kcgs.fitting.region_report import report_regions
from kcgs.fitting.state import FitResult, FitState, Gaussians, StopReason
from kcgs.pruning import prune
from kcgs.scene import Scene

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


@dataclass(frozen=True)
class Finish:
    """Measure the last state, take the best, refine it where it is flat, and remove what it does not need."""

    least_seconds: float = 0.01
    """What the refinement gets, though the clock be run down."""

    def apply(self, state: FitState, reason: StopReason) -> FitResult:
        """Return the result of a fit that ended for this reason."""
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
        if config.refine_flat and reason == "iterations" and is_flat(state.image, scene.regions, scene.num_gaussians):
            scene = self._refined(state, scene)
        removed, change = 0, 0.0
        if config.prune > 0:
            scene, removed, change = prune(scene, config.prune, cutoff=config.cutoff, backend=config.backend)
        dropped: Literal["recipe"] | None = None if config.guidance else "recipe"
        regions = report_regions(state.given, scene, merged_for_count=state.merged_for_count, dropped=dropped)
        return FitResult(scene, state.history, reason, config, removed, change, regions, state.seconds())

    def _refined(self, state: FitState, scene: Scene) -> Scene:
        """Refine a flat scene to its last digits, and write them down."""
        config, seconds = state.config, math.inf
        if config.max_seconds is not None:
            seconds = max(self.least_seconds, config.max_seconds - state.seconds())
        settings = {"max_seconds": seconds, "cutoff": config.cutoff, "backend": config.backend}
        scene = levenberg_marquardt(scene, state.image, **settings)  # type: ignore[arg-type]
        means, cholesky, colors = (t.detach() for t in (scene.field.means, scene.field.cholesky, scene.field.colors))
        gaussians = Gaussians(means, cholesky, colors, scene.field.region_ids, scene.regions)
        with torch.no_grad():
            log(state, render(state, gaussians), gaussians)
        return scene
