"""The fit: start, then densify, move contours, merge regions, render, log, step, until something says stop."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count
from kcgs._image import as_image
from kcgs._progress import Progress
from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap
from kcgs.kernels import prepare, threads_for_kernels

from .checkpoint import Checkpoint
from .config import FitConfig
from .descent import descend, log, log_is_due, render
from .search import Search
from .start import start
from .state import FitResult, FitState, HistoryEntry, StopReason
from .strategies import finish, make_strategies

OnStep = Callable[[int, HistoryEntry], bool | None]


@torch.inference_mode(False)
@torch.enable_grad()
def fit(
    image: Any,
    regions: RegionMap | Tensor | NDArray[Any] | None = None,
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

    Convention: the same arguments, device and number of threads give the same scene, bit for bit (unless it is stopped
    by the clock). The best state that was logged is returned, not the last; with a draft cutoff, the best of those that
    were rendered without. The scene holds fewer than N Gaussians where the recipe prunes, or its target takes fewer.
    With `target_psnr` several fits search for the fewest Gaussians that reach it, and the one found is returned;
    `on_step` counts the iterations of each.

    Args:
        image: Tensor :math:`(C, H, W)` or :math:`(1, C, H, W)`, floating, values in [0, 1]; a numpy array
            :math:`(H, W, C)`, uint8 or floating; or a PIL image.
        regions: label map of the image's size, integer or bool, a Tensor or a numpy array; or a RegionMap. Also says
            where EF-PSNR is measured. None: one region.
        num_gaussians: N, the most there may be, from 1 to the number of pixels. Where it is below the number of
            regions, those most alike are merged until each has a Gaussian, or with ``merge_regions=False`` the smaller
            ones stay empty and black; a UserWarning says how many.
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
        how many Gaussians were left out as useless, and what became of the regions.

    Raises:
        TypeError: wrong types.
        ValueError: an image that is not finite or not in [0, 1], regions of another size, N below 1 or
            above the number of pixels, unknown recipe or setting, a checkpoint that is damaged or of another fit.
        OSError: a checkpoint that cannot be written; found before the fit.

    Example:
        >>> image = torch.zeros(3, 16, 24)
        >>> image[:, :, 12:] = 1.0
        >>> result = fit(image, (image[0] > 0.5).long(), num_gaussians=4, recipe="paper", iterations=200)
        >>> result.history[-1].psnr > 20, result.scene.regions.num_regions
        (True, 2)
    """
    config = FitConfig.from_recipe(recipe, **settings)
    image, regions = check_problem(image, regions)
    num_gaussians = check_num_gaussians(num_gaussians, image)
    seed = check_count("seed", seed, 0, 2**63 - 1)
    if resume and checkpoint is None:
        raise InvalidArgument("checkpoint", "a file to go on from, with resume", None)
    if config.target_psnr is not None and checkpoint is not None:
        raise InvalidArgument("checkpoint", "None with target_psnr, which takes several fits", repr(checkpoint))
    prepare(config.backend, image.device, image.dtype, len(image))
    known = config.target_psnr is None
    with Progress("fit", known=known, shown=progress) as bar, threads_for_kernels(image[0].numel()):
        if not known:
            return Search(image, regions, num_gaussians, config, seed, lambda s: _run(s, bar, on_step)).search()
        state = start(image, regions, num_gaussians, config, seed, time.perf_counter())
        keeper = None if checkpoint is None else Checkpoint(checkpoint, state, regions)
        if keeper is not None and resume:
            keeper.read_into(state)
        _warn_of_regions(state)
        return finish(state, _run(state, bar, on_step, keeper))


def _run(state: FitState, bar: Progress, on_step: OnStep | None, keeper: Checkpoint | None = None) -> StopReason:
    """Descend, with what the strategies do meanwhile, until something says stop; return what did."""
    config, strategies = state.config, make_strategies(state)
    while state.iteration < state.limit:
        if not state.optimizer.is_finite():
            warnings.warn(f"the fit diverged at iteration {state.iteration}: the best so far is kept", stacklevel=5)
            return "diverged"
        share = state.progress()
        for strategy in strategies:
            if strategy.due(share):
                strategy.apply(state)
        rendered = render(state)
        if log_is_due(state):
            log(state, rendered)
        descend(state, rendered, share)

        entry = state.history[-1]
        bar.update(share, f"iteration {state.iteration}, {entry.num_gaussians} Gaussians, {entry.psnr:.2f} dB")
        if keeper is not None and (keeper.due() or state.iteration == state.limit):
            keeper.write(state)
        if on_step is not None and on_step(state.iteration, entry):
            return "callback"
        if state.seconds() >= (config.max_seconds or math.inf):
            return "seconds"
    return "iterations"


def check_num_gaussians(value: object, image: Tensor) -> int:
    """Return N if it is a number of Gaussians that an image (C, H, W) can use."""
    count, pixels = check_count("num_gaussians", value), image.shape[1] * image.shape[2]
    if count > pixels:
        size = f"{image.shape[2]} x {image.shape[1]}"
        raise InvalidArgument("num_gaussians", f"at most {pixels}, the pixels of the {size} image", count)
    return count


def _warn_of_regions(state: FitState) -> None:
    """Say where there are more regions than Gaussians."""
    most, count = state.num_gaussians, 0 if state.given is None else state.given.num_regions
    if count <= most or not state.config.guidance:
        return
    lost = f"{count - most} of {count} regions get no Gaussian and stay black"
    if state.config.merge_regions:
        lost = f"{count - most} of {count} regions were merged with others"
    warnings.warn(f"{lost}: there are more than num_gaussians, {most}", stacklevel=5)  # past the decorators


def check_problem(image: Any, regions: object) -> tuple[Tensor, RegionMap | None]:
    """Return the image, (C, H, W), and its regions, as copies that a fit may use; refuse what cannot be fitted."""
    image = as_image("image", image)
    regions = RegionMap.coerce(regions)
    if regions is not None:
        if regions.num_maps == 1:
            regions = regions.image(0)
        if regions.size != tuple(image.shape[1:]) or regions.num_maps is not None:
            expected = f"one map of the image's size {tuple(image.shape[1:])}"
            raise InvalidArgument("regions", expected, tuple(regions.labels.shape))
        regions = regions.to(image.device)
    dtype = torch.float64 if image.dtype == torch.float64 else torch.float32
    # a copy: an inference tensor cannot take part in a graph
    return image.detach().to(dtype, copy=True), regions
