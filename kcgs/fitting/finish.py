"""The end of a fit: the best scene, pruned."""

from __future__ import annotations

import torch

from kcgs.optim import Gaussians
from kcgs.pruning import prune

from .clock import Clock
from .measurement import measure_errors, snapshot
from .region_report import report_regions
from .removal import remove_gaussians
from .result import FitResult
from .state import Errors, FitState, Measurement, record


def finish(state: FitState, reason: str, clock: Clock) -> FitResult:
    """Measure the last scene, take the best, and prune it; return a fit that ended for a reason."""
    problem, config, best_draft, seconds = state.problem, state.problem.config, state.best, clock.seconds()
    with torch.no_grad():
        if state.is_draft:
            state.end_drafts()
            if best_draft is not None:
                renderer = state.renderer._replace(regions=best_draft.regions)
                errors = measure_errors(problem, renderer.render(Gaussians.of(best_draft.field)))
                # the draft was measured before, with another cutoff
                measurement = Measurement(state.iteration, seconds, best_draft, is_draft=False)
                record(state, measurement, Errors(*errors.tolist()))
        if reason != "diverged" and state.is_finite:
            remove_gaussians(state, state.num_gaussians - problem.num_gaussians)
            errors = measure_errors(problem, state.render())
            record(state, snapshot(state, seconds), Errors(*errors.tolist()))
    assert state.best is not None
    scene, num_pruned, prune_error = state.best, 0, 0.0
    if config.prune > 0:
        pruned = prune(scene, config.prune, cutoff=config.cutoff, backend=config.backend)
        scene, num_pruned, prune_error = pruned.scene, int(pruned.num_pruned), float(pruned.prune_error)
    report = report_regions(problem.regions, scene, dropped=None if config.guidance else "recipe")
    return FitResult(
        scene, state.history, reason, config, num_pruned, prune_error, report, clock.seconds(), state.best_psnr
    )
