"""The end of a fit: the best scene, pruned."""

from __future__ import annotations

import torch

from kcgs.kernels import settle
from kcgs.optim import Gaussians
from kcgs.pruning import prune

from .divergence import is_finite
from .events import EndDrafts
from .events.log import collect_measurements, measure
from .region_report import report_regions
from .removal import remove_gaussians
from .result import FitResult, StopReason
from .state import FitState


def finish(state: FitState, reason: StopReason, seconds: float) -> FitResult:
    """Measure the last scene, take the best, and prune it; return a fit that ended for a reason."""
    problem, config = state.problem, state.problem.config
    collect_measurements(state, wait=True)
    settle(problem.image.device, problem.size)
    best_draft = state.best if state.is_draft else None
    EndDrafts().act(state)
    with torch.no_grad():
        if best_draft is not None:
            renderer = state.renderer._replace(regions=best_draft.regions)
            measure(state, best_draft, renderer.render(Gaussians.of(best_draft.field)), seconds)
        if reason != "diverged" and is_finite(state.field):
            remove_gaussians(state, state.num_gaussians - problem.num_gaussians)
            measure(state, state.scene, state.render(), seconds)
    collect_measurements(state, wait=True)
    assert state.best is not None
    scene, num_pruned, prune_error = state.best, 0, 0.0
    if config.prune > 0:
        scene, num_pruned, prune_error = prune(scene, config.prune, cutoff=config.cutoff, backend=config.backend)
    report = report_regions(problem.regions, scene, dropped=None if config.guidance else "recipe")
    return FitResult(scene, state.history, reason, config, num_pruned, prune_error, report, seconds)
