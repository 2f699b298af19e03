"""The end of a fit: the best scene, pruned."""

from __future__ import annotations

from typing import Literal

import torch

from kcgs.optim import Gaussians
from kcgs.pruning import PruneResult, prune
from kcgs.scene import Scene

from .image_maps import map_of_each
from .measurement import Clock, Measurement, measure_errors, record, snapshot
from .problem import Problem
from .region_report import RegionReport, report_regions
from .removal import remove_gaussians
from .result import FitResult
from .state import FitState


def finish(state: FitState, reason: str, clock: Clock) -> FitResult:
    """Measure the last scene, prune the best scene, and return it with the reason why the fit ended."""
    _measure_last(state, clock.seconds())
    assert state.best is not None
    problem, config = state.problem, state.problem.config
    scene, psnr = state.best.scene, state.best.psnr
    pruned = PruneResult(scene, torch.zeros_like(psnr, dtype=torch.int64), torch.zeros_like(psnr))
    if not problem.is_batch:
        pruned = PruneResult(scene[0], 0, 0.0)
    if config.prune > 0:
        pruned = prune(pruned.scene, config.prune, cutoff=config.cutoff, backend=config.backend)
    return FitResult(
        pruned.scene, state.history, reason, config, pruned.num_pruned, pruned.prune_error,
        _report_regions(problem, pruned.scene), clock.seconds(), psnr if problem.is_batch else float(psnr),
        tuple(state.diverged),
    )  # fmt: skip


def _report_regions(problem: Problem, scene: Scene) -> RegionReport | list[RegionReport] | None:
    """Report what became of the map, or of the map of each image of a batch."""
    dropped: Literal["recipe"] | None = None if problem.config.guidance else "recipe"
    if problem.regions is None:
        return None
    if not problem.is_batch:
        return report_regions(problem.regions, scene, dropped=dropped)
    maps = map_of_each(problem.regions, problem.num_images)
    return [report_regions(one, part, dropped=dropped) for one, part in zip(maps, scene, strict=True)]


@torch.no_grad()
def _measure_last(state: FitState, seconds: float) -> None:
    """Measure the best scenes with the final cutoff, and the last scene of images that did not diverge."""
    problem = state.problem
    state.end_drafts()
    if state.best is not None and bool(state.best.is_draft.any()):
        scene = state.best.scene
        renderer = state.renderer._replace(regions=scene.regions)
        errors = measure_errors(problem, renderer.render(Gaussians.of(scene.field)))
        record(state, Measurement(state.iteration, seconds, scene, is_draft=False, excluded=[]), errors)
    state.exclude(state.overflowing_images())
    if not state.all_diverged:
        remove_gaussians(state, state.num_gaussians - problem.num_gaussians)
        record(state, snapshot(state, seconds), measure_errors(problem, state.render()))
