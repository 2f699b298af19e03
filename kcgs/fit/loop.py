"""The fit: initialize, then grow, render, step, log, until something says stop."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from kcgs._check import check_image
from kcgs.functional import RegionMap

from .checkpoint import Checkpoint
from .config import FitConfig
from .monitor import FitResult, HistoryEntry, StopReason
from .session import Session


@torch.inference_mode(False)
@torch.enable_grad()
def fit(
    image: Tensor,
    regions: RegionMap | Tensor | None = None,
    num_gaussians: int = 1000,
    *,
    recipe: str = "best",
    seed: int = 0,
    config: FitConfig | None = None,
    on_step: Callable[[int, HistoryEntry], bool | None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
) -> FitResult:
    r"""Fit a field of Gaussians to an image.

    Convention: the same arguments, device and number of threads give the same field, bit for bit (unless it is stopped
    by the clock). The best state that was logged is returned, not the last; with a draft cutoff, the best of those that
    were drawn without. The field holds fewer than N Gaussians where the recipe prunes, or reaches its target sooner.

    Args:
        image: :math:`(C, H, W)` or :math:`(1, C, H, W)`, floating, values in [0, 1].
        regions: label map of the image's size, or a RegionMap; also says where EF-PSNR is measured. None: one region.
        num_gaussians: N, at least 1; with `target_psnr` and growth, the most there may be. Where it is below the number
            of regions, the smaller ones stay empty and black, and a UserWarning says how many.
        recipe: a name from :func:`available_recipes`; not read where `config` is given.
        seed: of the random start.
        config: all settings.
        on_step: called after every iteration with its number (from 1) and the last history entry; returning True
            stops the fit.
        checkpoint: a file to write the state to from time to time, whole or not at all.
        resume: go on from `checkpoint` where it exists; the result is that of an uninterrupted fit.

    Returns:
        Field, regions to draw it with (moved, or united, where the recipe does so), history, why it stopped, settings,
        and how many Gaussians were left out as useless.

    Raises:
        TypeError: wrong types.
        ValueError: an image that is not finite or not in [0, 1], regions of another size, N below 1, unknown recipe,
            a checkpoint that is damaged or of another fit.

    Example:
        >>> image = torch.zeros(3, 16, 24)
        >>> image[:, :, 12:] = 1.0
        >>> config = FitConfig.from_recipe("paper", iterations=200)
        >>> result = fit(image, (image[0] > 0.5).long(), num_gaussians=4, config=config)
        >>> result.history[-1].psnr > 20
        True
    """
    config = FitConfig.from_recipe(recipe) if config is None else config
    start = time.perf_counter()
    image, regions = check_problem(image, regions, num_gaussians)
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise ValueError(f"seed must be an integer in [0, 2**63); got {seed!r}")
    if resume and checkpoint is None:
        raise ValueError("resume needs checkpoint, a file to go on from; got None")
    keeper = None if checkpoint is None else Checkpoint(checkpoint, image, regions, config, num_gaussians, seed)
    state = keeper.read() if keeper is not None and resume else None
    session = Session(image, regions, num_gaussians, config, seed, start)
    if state is not None:
        session.load(state)

    reason: StopReason | None = None
    while reason is None and session.iteration < config.iterations:
        if not session.descent.is_finite():
            warnings.warn(f"the fit diverged at iteration {session.iteration}: the best so far is kept", stacklevel=4)
            reason = "diverged"
            break
        progress = session.progress()
        session.sharpen(progress)
        session.refresh_ids()
        session.grow(progress)
        session.settle(progress)
        session.release(progress)
        picture = session.draw()
        if session.log_is_due(progress):
            session.log(picture)
            if config.target_psnr is not None and session.monitor.best_psnr >= config.target_psnr:
                reason = "target_psnr"
                break
        session.step(picture, progress)

        if keeper is not None and (keeper.due() or session.iteration == config.iterations):
            keeper.write(session.state())
        if on_step is not None and on_step(session.iteration, session.monitor.history[-1]):
            reason = "callback"
        elif session.monitor.seconds() >= (config.max_seconds or math.inf):
            reason = "seconds"
    return session.finish(reason or "iterations")


def check_problem(
    image: Tensor, regions: RegionMap | Tensor | None, num_gaussians: int = 1
) -> tuple[Tensor, RegionMap | None]:
    """Return the image, (C, H, W), and its regions, as copies that a fit may use; refuse what cannot be fitted."""
    image = check_image("image", image)
    if image.ndim == 4:
        if image.shape[0] != 1:
            raise ValueError(f"image must be one image, (C, H, W) or (1, C, H, W); got {tuple(image.shape)}")
        image = image[0]
    if image.min() < 0 or image.max() > 1:
        raise ValueError(f"image must be in [0, 1]; got [{float(image.min()):g}, {float(image.max()):g}]")
    if isinstance(num_gaussians, bool) or not isinstance(num_gaussians, int):
        raise TypeError(f"num_gaussians must be an integer; got {num_gaussians!r}")
    if num_gaussians < 1:
        raise ValueError(f"num_gaussians must be at least 1; got {num_gaussians}")
    if isinstance(regions, Tensor):
        regions = RegionMap.from_labels(regions)
    if regions is not None:
        if not isinstance(regions, RegionMap):
            raise TypeError(f"regions must be a RegionMap, a label map Tensor or None; got {type(regions).__name__}")
        if regions.size != tuple(image.shape[1:]) or regions.labels.ndim != 2:
            raise ValueError(
                f"regions must be one map of the image's size {tuple(image.shape[1:])}; got "
                f"{tuple(regions.labels.shape)}"
            )
        regions = regions.to(image.device)
    dtype = torch.float64 if image.dtype == torch.float64 else torch.float32
    # a copy: an inference tensor cannot take part in a graph
    return image.detach().to(dtype, copy=True), regions
