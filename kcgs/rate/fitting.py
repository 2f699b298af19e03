"""Fit an image to a file of at most `target_bytes`: choose the regions, fit, and round."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from kcgs._check import check_count
from kcgs._progress import Progress
from kcgs._repr import brief
from kcgs.codec import SceneWriter, decode
from kcgs.compiled import threads_for_kernels
from kcgs.errors import InvalidArgument
from kcgs.fitting import FitConfig, FitResult, HistoryEntry, Problem, fit_problem, make_problem, report_regions
from kcgs.nn import GaussianField, area_mean, scaled_gaussians
from kcgs.scene import Scene

from .budget import FIT_SHARE, FIT_SHARE_WITH_REGIONS, budget_of, min_sigma_of, reduction_of
from .compress import Compressor
from .region_choice import MIN_BYTES, RegionChoice, choose_regions

# share of all iterations that the few Gaussians of a reduced photo take; tuned like the budgets. More: slower
_REDUCED_SHARE = 0.7


@brief
class FitBytesResult(NamedTuple):
    """A file, the scene that it decodes to, and the fit before rounding.

    If the fit was on a reduced photo, the PSNR of its history is that of the reduced photo.
    """

    data: bytes
    scene: Scene
    result: FitResult


@torch.inference_mode(False)
@torch.enable_grad()
def fit_bytes(
    image: Any,
    regions: Any,
    target_bytes: int,
    *,
    recipe: str | FitConfig = "best",
    seed: int = 0,
    on_step: Callable[[int, HistoryEntry], bool | None] | None = None,
    progress: bool = False,
    **settings: Any,
) -> FitBytesResult:
    """Fit an image to a file of at most `target_bytes`, everything included.

    Convention: all bits save about the same error. For the chosen number of Gaussians, one more Gaussian saves as much
    as finer rounding of all. A pixel of contour must save as much error as Gaussians of the same bits would; otherwise
    it moves, or its regions are merged. The map is used if a short fit with it has less error, in the image and along
    the contours, than a short fit without it and with more Gaussians. With ``merge_regions=False`` the whole map is
    used. ``result.regions`` reports the changes of the map.

    The objective is ms-ssim by default. It gives Gaussians a least width that grows with their spacing: thin Gaussians
    look like stray strokes. If a file has few bytes per pixel, the fit runs on a reduced photo, without a map unless
    ``merge_regions=False``; the scene still has the size of the photo.

    Args:
        image: as in :func:`kcgs.fit`.
        regions: as in :func:`kcgs.fit`.
        target_bytes: largest size of the file, at least 40.
        recipe: as in :func:`kcgs.fit`.
        seed: as in :func:`kcgs.fit`.
        on_step: as in :func:`kcgs.fit`, for the fit itself, not for the trials.
        progress: as in :func:`kcgs.fit`.
        settings: as in :func:`kcgs.fit`. The cost of a contour's bits replaces `contour_cost`; `max_seconds` limits
            the fit alone. Without `max_seconds` the rate-distortion descent replaces the last 11 or 15 % of the
            iterations. A fit has 500 iterations, 350 on a reduced photo, 700 with the objective l2.

    Returns:
        The file, the scene that it decodes to, and the fit.

    Raises:
        TypeError, ValueError: as :func:`kcgs.fit`; `target_bytes` below 40, or too small for a map that is to be kept;
            an objective that is neither l2 nor ms-ssim, such as that of a recipe.

    Example:
        >>> import torch
        >>> image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> data, scene, _ = fit_bytes(image, None, 200, iterations=50)
        >>> len(data) <= 200, scene.regions
        (True, None)
    """
    config = FitConfig.from_recipe(recipe, **settings)
    if config.target_psnr is not None:
        raise InvalidArgument("target_psnr", "None with target_bytes", config.target_psnr)
    check_count("target_bytes", target_bytes, MIN_BYTES)
    problem = make_problem(image, regions, None, config, seed, purpose="file of a size")
    with Progress("trial fits", pulse=True, visible=progress), threads_for_kernels(problem.target[0, 0].numel()):
        choice = choose_regions(problem, target_bytes)
    reduced = _reduce(problem, choice)
    share = FIT_SHARE if choice.regions is None else FIT_SHARE_WITH_REGIONS
    result = fit_problem(reduced, on_step, progress, until=1.0 if config.max_seconds else share)
    scene = _enlarge(result.scene, problem.size)
    with Progress("writing the file", pulse=True, visible=progress), threads_for_kernels(reduced.target[0, 0].numel()):
        objective = reduced.make_objective(reduced.target[0].to("cpu", torch.float32))
        min_sigma = min_sigma_of(problem, choice.num_gaussians)
        iterations = _shorten(budget_of(problem.config).compress_iterations, reduced.reduction)
        compressor = Compressor(SceneWriter(scene), objective, iterations, seed, min_sigma)
        data = compressor.search_bytes(target_bytes)
    report = None
    if problem.regions is not None:
        report = report_regions(
            problem.regions, scene, merged_for_bytes=choice.merged_for_bytes, dropped=choice.dropped
        )
    return FitBytesResult(data, decode(data).scene, result._replace(scene=scene, regions=report))


def _reduce(problem: Problem, choice: RegionChoice) -> Problem:
    """Return the problem of the fit: without a map, the photo is reduced as far as the least width allows."""
    config, (height, width) = problem.config, problem.size
    min_sigma = min_sigma_of(problem, choice.num_gaussians)
    reduction = reduction_of(min_sigma) if choice.regions is None else 1
    update: dict[str, Any] = {"contour_cost": choice.contour_cost, "min_sigma": min_sigma / reduction}
    if config.iterations is None and config.max_seconds is None:
        update["iterations"] = _shorten(budget_of(config).fit_iterations, reduction)
    config = config.model_copy(update=update)
    return replace(
        problem, target=area_mean(problem.target, (-(-height // reduction), -(-width // reduction))),
        regions=choice.regions, num_gaussians=choice.num_gaussians, config=config, reduction=reduction,
    )  # fmt: skip


def _shorten(iterations: int, reduction: int) -> int:
    """Return the iterations on a reduced photo."""
    return iterations if reduction == 1 else round(_REDUCED_SHARE * iterations)


def _enlarge(scene: Scene, size: tuple[int, int]) -> Scene:
    """Scale the scene of a reduced photo to the size of the photo."""
    if scene.size == size:
        return scene
    field = scene.field
    means, cholesky = scaled_gaussians(field, size)
    return Scene(GaussianField(means, cholesky, field.colors, opacities=field.opacities, size=size))
