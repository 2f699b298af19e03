"""The end of a fit: the best scene, pruned."""

from __future__ import annotations

import torch

from kcgs.kernels import settle
from kcgs.pruning import prune

from .descent import is_finite, render
from .log import log, take_up
from .region_report import report_regions
from .removal import remove_gaussians
from .result import FitResult, StopReason
from .state import FitState
from .strategies import EndDrafts


def finish(state: FitState, reason: StopReason, seconds: float) -> FitResult:
    """Measure the last scene, take the best, and prune it; return a fit that ended for a reason."""
    problem, config = state.problem, state.problem.config
    take_up(state, wait=True)
    settle(problem.image.device, problem.size)
    best_draft = None if state.cutoff == config.cutoff else state.best
    EndDrafts().apply(state)
    with torch.no_grad():
        if best_draft is not None:
            log(state, render(state, best_draft), seconds, best_draft)
        if reason != "diverged" and is_finite(state.scene.field):
            remove_gaussians(state, state.num_gaussians - problem.num_gaussians)
            log(state, render(state), seconds)
    take_up(state, wait=True)
    assert state.best is not None
    scene, num_pruned, prune_error = state.best, 0, 0.0
    if config.prune > 0:
        scene, num_pruned, prune_error = prune(scene, config.prune, cutoff=config.cutoff, backend=config.backend)
    report = report_regions(problem.regions, scene, dropped=None if config.guidance else "recipe")
    return FitResult(scene, state.history, reason, config, num_pruned, prune_error, report, seconds)
