"""The fit: start, then strategies, render, log, backward and step, until something stops it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import nullcontext
from functools import lru_cache
from typing import Any

import torch

from kcgs._progress import Progress
from kcgs._warn import warn_user
from kcgs.compiled import threads_for_kernels
from kcgs.errors import InvalidArgument
from kcgs.kernels import prepare, settle, without_waiting

from .captured import CapturedStep, is_capturable
from .checkpoint import Checkpoint
from .clock import Clock
from .config import FitConfig
from .descent import backward, has_diverged, render
from .finish import finish
from .log import log, log_is_due, take_up
from .optimizers import set_learning_rates
from .problem import Problem, make_problem
from .result import FitResult, HistoryEntry, StopReason
from .search import search
from .start import start
from .state import FitState
from .strategies import make_strategies

OnStep = Callable[[int, HistoryEntry], bool | None]

# at the start of a fit on a device that wait for it, since Gaussians may grow faster than the room for their lists
_CHECKED_ITERATIONS = 20


@torch.inference_mode(False)
@torch.enable_grad()
def fit(
    image: Any,
    regions: Any = None,
    num_gaussians: int = 1000,
    *,
    recipe: str | FitConfig = "best",
    seed: int = 0,
    on_step: OnStep | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    **settings: Any,
) -> FitResult:
    r"""Fit Gaussians to an image.

    Convention: on one device, the same arguments and number of threads give the same scene, bit for bit (unless the
    clock stops it). On a GPU the history comes up to 20 iterations late. The best state that was logged is returned,
    not the last. The first 85 % of a fit render drafts with a larger cutoff, and are not compared with the rest. The
    scene holds fewer than N Gaussians where the recipe prunes, or its target takes fewer. With `target_psnr` several
    fits search for the fewest Gaussians that reach it; `on_step` counts the iterations of each.

    Args:
        image: Tensor :math:`(C, H, W)` or :math:`(1, C, H, W)`, floating, values in [0, 1]; a numpy array
            :math:`(H, W, C)`, uint8 or floating; a PIL image; or a path, as :func:`kcgs.data.load_image` reads it.
        regions: label map of the image's size: a Tensor or a numpy array, integer or bool, a PIL image, or a path, as
            :func:`kcgs.data.load_labels` reads it; or a RegionMap. EF-PSNR is measured along its contours. None: one
            region.
        num_gaussians: N, the most there may be, from 1 to the number of pixels. Where it is below the number of
            regions, those most alike are merged until each has a Gaussian, or with ``merge_regions=False`` the smaller
            ones stay empty and black; a UserWarning gives their number.
        recipe: a name from :func:`available_recipes`, or settings.
        seed: of the random start.
        on_step: called after every iteration with its number (from 1) and the last history entry; returning True
            stops the fit.
        progress: show a bar, on a terminal or in a notebook.
        checkpoint: a file to write the state to from time to time, whole or not at all.
        resume: go on from `checkpoint` where it exists; the result is that of an uninterrupted fit.
        settings: fields of :class:`FitConfig`, in place of the recipe's.

    Returns:
        The scene (its contours moved, its regions merged, where the recipe does so), history, why it stopped, settings,
        how many Gaussians were pruned, and what became of the regions.

    Raises:
        TypeError: wrong types.
        ValueError: an image that is not finite or not in [0, 1], regions of another size, N below 1 or
            above the number of pixels, unknown recipe or setting, a checkpoint that is damaged or of another fit.
        OSError: a checkpoint that cannot be written; raised before the fit.

    Example:
        >>> image = torch.zeros(3, 16, 24)
        >>> image[:, :, 12:] = 1.0
        >>> result = fit(image, (image[0] > 0.5).long(), num_gaussians=4, recipe="paper", iterations=200)
        >>> result.history[-1].psnr > 20, result.scene.regions.num_regions
        (True, 2)
    """
    config = FitConfig.from_recipe(recipe, **settings)
    problem = make_problem(image, regions, num_gaussians, config, seed)
    if resume and checkpoint is None:
        raise InvalidArgument("checkpoint", "a file to go on from, with resume", None)
    if config.target_psnr is not None and checkpoint is not None:
        raise InvalidArgument("checkpoint", "None with target_psnr, which takes several fits", repr(checkpoint))
    return fit_problem(problem, on_step, progress, checkpoint, resume)


@lru_cache(maxsize=64)
def precompile(config: FitConfig, device: torch.device | str = "cpu") -> None:
    """Compile and load what fits of these settings need, so that no clock counts it; with `max_seconds`, `fit` does."""
    ramp = torch.linspace(0.0, 1.0, 96, device=device)
    image = torch.stack([ramp.expand(64, 96), 1 - ramp.expand(64, 96), (8 * ramp).sin().square().expand(64, 96)])
    labels = (ramp > 0.6).long().expand(64, 96).contiguous()
    iterations = min(config.usual_iterations, 20)
    update = {"iterations": iterations, "max_seconds": None, "target_psnr": None, "backend": "auto"}
    fit(image, labels, 24, recipe=config.model_copy(update=update))


def fit_problem(
    problem: Problem,
    on_step: OnStep | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
) -> FitResult:
    """Solve a problem whose arguments are checked: see `fit`, which brings autograd's modes."""
    if problem.config.max_seconds is not None:
        precompile(problem.config, problem.image.device)
    prepare(problem.config.backend, problem.image.device, problem.image.dtype, len(problem.image))
    _warn_of_regions(problem)
    searches = problem.config.target_psnr is not None
    with Progress("fit", pulse=searches, visible=progress) as bar, threads_for_kernels(problem.image[0].numel()):
        if searches:
            return search(problem, lambda state: _run(state, Clock(), bar, on_step))
        store = None if checkpoint is None else Checkpoint(checkpoint, problem)
        if store is not None and resume and store.path.exists():
            state, seconds = store.read()
            return _run(state, Clock(seconds), bar, on_step, store)
        clock = Clock()
        return _run(start(problem), clock, bar, on_step, store)


def _run(
    state: FitState, clock: Clock, bar: Progress, on_step: OnStep | None, store: Checkpoint | None = None
) -> FitResult:
    """Take a fit from its state to its end."""
    problem, config = state.problem, state.problem.config
    limit, max_seconds = config.max_iterations, config.max_seconds or math.inf
    strategies = make_strategies(config)
    reason: StopReason = "iterations"
    first, captured = state.iteration, CapturedStep()
    while state.iteration < limit:
        state.progress = max(state.iteration / limit, clock.seconds() / max_seconds)
        if has_diverged(state):
            warn_user(f"the fit diverged at iteration {state.iteration}: the best so far is kept")
            reason = "diverged"
            break
        for strategy in strategies:
            if strategy.due(state):
                strategy.apply(state)
                state.waits = True
        if state.waits:
            settle(problem.image.device, problem.size)
            captured.forget()
        waits = state.waits or not state.runs_ahead or state.iteration < first + _CHECKED_ITERATIONS
        replays = not waits and is_capturable(state)
        set_learning_rates(state.optimizer, config, state.progress)
        with nullcontext() if waits else without_waiting(), torch.set_grad_enabled(not replays):
            rendered = None
            if log_is_due(state, clock.seconds()):
                rendered = render(state)
                log(state, rendered, clock.seconds())
            if replays:
                captured(state)
            else:
                backward(state, rendered)
                state.optimizer.step()
        state.waits = False
        state.iteration += 1

        take_up(state, wait=False)
        entry = state.history[-1]
        bar.update(state.progress, f"iteration {state.iteration}, {entry.num_gaussians} Gaussians, {entry.psnr:.2f} dB")
        if store is not None and (store.due() or state.iteration == limit):
            store.write(state, clock.seconds())
        if on_step is not None and on_step(state.iteration, entry):
            reason = "callback"
            break
        if clock.seconds() >= max_seconds:
            reason = "seconds"
            break
    return finish(state, reason, clock.seconds())


def _warn_of_regions(problem: Problem) -> None:
    """Warn where there are more regions than Gaussians."""
    most, count = problem.num_gaussians, 0 if problem.regions is None else problem.regions.num_regions
    if count <= most or not problem.config.guidance:
        return
    effect = f"{count - most} of {count} regions get no Gaussian and stay black"
    if problem.config.merge_regions:
        effect = f"{count - most} of {count} regions were merged with others"
    warn_user(f"{effect}: there are more than num_gaussians, {most}")
