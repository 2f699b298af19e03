"""The fit: a start, a descent with its events, and an end."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import torch

from kcgs._progress import Progress
from kcgs._warn import warn_user
from kcgs.compiled import threads_for_kernels
from kcgs.errors import InvalidArgument
from kcgs.kernels import warm_up
from kcgs.nn import GaussianField
from kcgs.optim import End, Event, Loss, TimedAction, run

from .checkpoint import Checkpoint
from .config import FitConfig
from .events import Densify, HandleDivergence, Log, OnStep, Report, SettleContours, Warmup
from .finish import finish
from .image_maps import regions_per_map
from .measurement import Clock
from .problem import Problem, make_problem
from .result import FitResult
from .search import search
from .start import start
from .state import FitState
from .stepper import Stepper, make_stepper
from .user_objects import Densifier, Initializer, split_names

# share of a fit that renders with the cutoff of a draft
_DRAFT_SHARE = 0.85


@torch.inference_mode(False)
@torch.enable_grad()
def fit(
    image: Any,
    regions: Any = None,
    num_gaussians: int | None = None,
    *,
    recipe: str | FitConfig = "best",
    objective: str | Loss | None = None,
    initializer: str | Initializer | None = None,
    densify: Densifier | None = None,
    optimizer: str | Callable[[GaussianField], Any] | None = None,
    seed: int = 0,
    on_step: OnStep | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    size: tuple[int, int] | None = None,
    channels: int = 3,
    **settings: Any,
) -> FitResult:
    r"""Fit Gaussians to an image, or to all images of a batch at once.

    Convention: on one device, the same arguments and number of threads give the same scene, bit for bit (unless the
    clock stops the fit). On a GPU history entries arrive up to 20 iterations late. The result is the best measured
    scene, not the last. In the first 85 % of a fit, scenes are drafts with a larger cutoff; later scenes rank
    above all drafts. With `target_psnr`, several fits search for about the fewest Gaussians that reach it, and
    `on_step` counts the iterations of each fit. The scene may have fewer than N Gaussians: pruning removes some, and a
    search ends with fewer.

    All images of a batch have the same number of rows; rows that an image does not need are unused, with the colour 0.
    On a CPU each image gets, bit for bit, the scene that it gets alone with the same seed. The exceptions: the clock
    stops the fit, there are hardly more Gaussians than regions, or the image does not need all its Gaussians. An image
    whose numbers overflow keeps its best scene, with a UserWarning; the other images go on. The history has means over
    the images.

    The history's `loss` is the value of the objective. With a loss of your own, such as a loss of Kornia, the result is
    the scene with the lowest loss. Gaussians are added where the render differs from the image, and contours move to
    the image's edges. Without an image, Gaussians are added where the gradient of the loss is large, contours stay, and
    PSNR is NaN.

    Args:
        image: Tensor :math:`(C, H, W)`, or a batch :math:`(B, C, H, W)`, floating, values in [0, 1]; a numpy array
            :math:`(H, W, C)`, uint8 or floating; a PIL image; or a path, as :func:`kcgs.data.load_image` reads it.
            None with a loss of your own that does not need it.
        regions: label map of the image's size: a Tensor or a numpy array, integer or bool, a PIL image, or a path, as
            :func:`kcgs.data.load_labels` reads it; or a RegionMap. EF-PSNR is measured along its contours. None: one
            region. A batch has one map for all images, or one for each.
        num_gaussians: N, the most Gaussians of each image, from 1 to the number of pixels; None: one per 100 pixels,
            at least 100. If N is below the number of regions, similar regions are merged until there are N; with
            ``merge_regions=False`` the smaller regions stay empty and black. A UserWarning gives their number.
        recipe: a name from :func:`available_recipes`, or settings.
        objective: the loss to minimize, by its name in :class:`FitConfig`; or a function of your own from a render,
            :math:`(1, C, H, W)`, not clipped, to a differentiable scalar. None: the recipe's objective, else l2.
        initializer: the first Gaussians, by a name of :class:`FitConfig`; or a function of the images,
            :math:`(B, C, H, W)` (grey images where `image` is None), the number of Gaussians to begin with, a RegionMap
            or None, and the seed, as :func:`kcgs.fitting.initial_field` takes them. It returns a GaussianField with
            this batch size, and with region ids if there is a map. None: the recipe's initializer.
        densify: an event of your own that adds Gaussians: an object with ``act(state)``, called before every step, and
            ``end``, the share of the fit at its last addition. None: matching pursuit.
        optimizer: a name of :class:`FitConfig`, or a function from a field to an optimizer with the members of
            :class:`kcgs.optim.FieldOptimizer`, such as a :class:`kcgs.optim.ReparametrizedOptimizer`; for one image
            without ``freeze`` and ``frozen_rows``. None: the recipe's optimizer.
        seed: of the random start.
        on_step: called after every iteration with its number (from 1) and the last history entry; returning True
            stops the fit.
        progress: show a bar, on a terminal or in a notebook.
        checkpoint: a file for the state, replaced atomically from time to time.
        resume: go on from `checkpoint` where it exists; the result is that of an uninterrupted fit.
        size: (height, width) of the render, without an image.
        channels: C, without an image.
        settings: other fields of :class:`FitConfig`, in place of the recipe's.

    Returns:
        The scene (with moved contours and merged regions, if the recipe does so), the history, why the fit stopped, the
        settings, the number of pruned Gaussians, and what became of the regions. For :math:`(B, C, H, W)`, also with
        B = 1, the scene is a batch, and PSNR and the number of pruned Gaussians are :math:`(B)`.

    Raises:
        TypeError: wrong types.
        ValueError: an image that is not finite or not in [0, 1], regions of another size, N below 1 or
            above the number of pixels, unknown recipe or setting, a checkpoint that is damaged or of another fit, a
            checkpoint together with functions of your own, which no file can hold; no image and no size; a loss that is
            no scalar or does not depend on the render; first Gaussians of another number or size; an optimizer that
            lacks a member; several images with `target_psnr`, a checkpoint or a loss of your own; more images than fit
            into memory.
        OSError: a checkpoint that cannot be written; raised before the fit.

    Example:
        >>> image = torch.zeros(3, 16, 24)
        >>> image[:, :, 12:] = 1.0
        >>> result = fit(image, (image[0] > 0.5).long(), num_gaussians=4, recipe="paper", iterations=200)
        >>> result.history[-1].psnr > 20, result.scene.regions.num_regions
        (True, 2)
        >>> batch = fit(torch.rand(4, 3, 16, 24), num_gaussians=8, iterations=50)
        >>> len(batch.scene), batch.scene.render().shape, batch.psnr.shape
        (4, torch.Size([4, 3, 16, 24]), torch.Size([4]))
    """
    named, objects = split_names(objective=objective, initializer=initializer, densify=densify, optimizer=optimizer)
    config = FitConfig.from_recipe(recipe, **named, **settings)
    problem = make_problem(image, regions, num_gaussians, config, seed, objects, size=size, channels=channels)
    if resume and checkpoint is None:
        raise InvalidArgument("checkpoint", "a file to go on from, with resume", None)
    functions = [name for name, value in objects._asdict().items() if value is not None]
    if functions and checkpoint is not None:
        expected = f"None with {functions[0]} of your own, which no file keeps"
        raise InvalidArgument("checkpoint", expected, repr(checkpoint))
    if problem.num_images > 1 and checkpoint is not None:
        raise InvalidArgument(
            "checkpoint", f"None with {problem.num_images} images: fit them one by one", repr(checkpoint)
        )
    if config.target_psnr is not None and checkpoint is not None:
        raise InvalidArgument("checkpoint", "None with target_psnr, which takes several fits", repr(checkpoint))
    return fit_problem(problem, on_step, progress, checkpoint, resume)


@lru_cache(maxsize=64)
def precompile(config: FitConfig, device: torch.device | str = "cpu") -> None:
    """Compile and load all that a fit with these settings needs; with `max_seconds`, `fit` does so before its clock."""
    ramp = torch.linspace(0.0, 1.0, 96, device=device)
    image = torch.stack([ramp.expand(64, 96), 1 - ramp.expand(64, 96), (8 * ramp).sin().square().expand(64, 96)])
    labels = (ramp > 0.6).long().expand(64, 96).contiguous()
    iterations = min(config.planned_iterations, 20)
    update: dict[str, Any] = {"iterations": iterations, "max_seconds": None, "target_psnr": None, "backend": "auto"}
    fit(image, labels, 24, recipe=config.model_copy(update=update))


def fit_problem(
    problem: Problem,
    on_step: OnStep | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    until: float = 1.0,
    stepper_of: Callable[[FitState], Stepper] = make_stepper,
) -> FitResult:
    """Fit a checked problem, up to the share `until` of its schedule: see `fit`."""
    target = problem.target
    if problem.config.max_seconds is not None:
        precompile(problem.config, target.device)
    warm_up(problem.config.backend, target.device, target.dtype, target.shape[1])
    _warn_of_regions(problem)
    searches = problem.config.target_psnr is not None
    with Progress("fit", pulse=searches, visible=progress) as bar, threads_for_kernels(target[0, 0].numel()):
        run_from = partial(_run, stepper_of=stepper_of, bar=bar, on_step=on_step)
        if searches:
            return search(problem, lambda state: run_from(state, Clock()))
        store = None if checkpoint is None else Checkpoint(checkpoint, problem)
        if store is not None and resume and store.path.exists():
            state, seconds = store.read()
            return run_from(state, Clock(seconds), store=store, until=until)
        clock = Clock()
        return run_from(start(problem), clock, store=store, until=until)


def _run(
    state: FitState,
    clock: Clock,
    *,
    stepper_of: Callable[[FitState], Stepper],
    bar: Progress,
    on_step: OnStep | None,
    store: Checkpoint | None = None,
    until: float = 1.0,
) -> FitResult:
    """Run a fit from its state to its end: before each step the events act."""
    config, stepper = state.problem.config, stepper_of(state)
    limit, max_seconds = config.iteration_limit, config.max_seconds or math.inf

    def progress() -> float:
        return min(1.0, max(state.iteration / limit, clock.seconds() / max_seconds))

    end = End(until, lambda: "seconds" if clock.seconds() >= max_seconds else "iterations")
    report = Report(stepper, clock, bar, on_step, store)
    events: list[Event] = [report, end, HandleDivergence(stepper), *make_schedule(state), Log(stepper, clock)]
    reason = run(state, stepper.step, progress, events, state.optimizer.rate)
    stepper.poll(wait=True)
    return finish(state, reason, clock)


def make_schedule(state: FitState) -> list[Event]:
    """Return the events that change the scene as the settings ask for, in the order in which they act."""
    config, densify = state.problem.config, state.problem.objects.densify or Densify()
    events: list[Event] = [TimedAction([_DRAFT_SHARE], state.end_drafts)]
    if config.warmup:
        events.append(Warmup())
    events.append(densify)
    if config.move_contours:
        events.append(SettleContours(densify.end))
    return events


def _warn_of_regions(problem: Problem) -> None:
    """Warn where there are more regions than Gaussians."""
    if problem.num_excess_regions > 0 and problem.regions is not None:
        total = sum(regions_per_map(problem.regions))
        warn_user(describe_excess(problem.num_excess_regions, total, problem.num_gaussians, problem.config))


def describe_excess(excess: int, num_regions: int, num_gaussians: int, config: FitConfig) -> str:
    """Say what becomes of the regions beyond the number of Gaussians."""
    effect = "were merged with others" if config.merge_regions else "get no Gaussian and stay black"
    return f"{excess} of {num_regions} regions {effect}: there are more than num_gaussians, {num_gaussians}"
