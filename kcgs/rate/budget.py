"""Fit an image to a file of at most `target_bytes`: choose N and the regions, fit, and round."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs._objectives import ObjectiveName
from kcgs._progress import Progress
from kcgs._repr import brief
from kcgs.codec import SceneWriter, decode, encode_region_map
from kcgs.compiled import threads_for_kernels
from kcgs.errors import InvalidArgument
from kcgs.fitting import FitConfig, FitResult, HistoryEntry, Problem, fit_problem, make_problem, report_regions
from kcgs.functional import merge_regions
from kcgs.maps import RegionMap, contour_edges, edge_band, pairs_to_merge
from kcgs.nn import GaussianField, area_mean, scaled_gaussians
from kcgs.scene import Scene

from .compress import Compressor

# fixed-point iterations for the number of Gaussians, since the bits per Gaussian depend on it
_COUNT_ITERATIONS = 4
# least size of a file: one Gaussian without a map
_MIN_BYTES = 40


@dataclass(frozen=True)
class GaussianBudget:
    """The number of Gaussians for a size of a file, their least width, and the iterations of fit and rounding.

    With more Gaussians there are fewer bits for each: the fit has less error, and rounding adds more. All fields are
    tuned. To tune one again, change it and compare the files of ``python -m benchmarks rate``: all have the same size.
    """

    bits_per_gaussian: float = 25.2
    """Bits of the file per Gaussian of the fit, at `reference_count` Gaussians and without the least number of bits.
    More: fewer Gaussians, each rounded less."""
    reference_count: int = 2100
    """Number of Gaussians for which `bits_per_gaussian` holds."""
    bits_per_doubling: float = 1.9
    """Increase of the bits per Gaussian for each doubling of the number of Gaussians. More: large files get fewer
    Gaussians."""
    min_bits_per_gaussian: float = 26.0
    """Least bits per Gaussian. With the other defaults they hold for up to 2,800 Gaussians."""
    header_bytes: int = 30
    """Bytes of a file besides Gaussians and map."""
    least_spacing: float = math.inf
    """Spacing of Gaussians, sqrt(pixels / N), in pixels, above which they have a least width. More: sharper edges, and
    more stray strokes."""
    width_per_spacing: float = 0.12
    """Least standard deviation, in pixels, per pixel of spacing above `least_spacing`. More: softer images, and fewer
    stray strokes."""

    fit_iterations: int = 700
    """Iterations of the schedule of a fit. More: slower, and less error."""
    compress_iterations: int = 600
    """Renders that descent and rounding together take. More: slower, and less error."""

    def num_gaussians(self, target_bytes: float, pixels: int) -> int:
        """Return the number of Gaussians, from 1 to `pixels`, of a file of at most `target_bytes` without a map."""
        bits = 8 * max(target_bytes - self.header_bytes, 1)
        count = bits / self.bits_per_gaussian
        for _ in range(_COUNT_ITERATIONS):
            doublings = math.log2(max(count, 1.0) / self.reference_count)
            bits_per_gaussian = self.bits_per_gaussian + self.bits_per_doubling * doublings
            count = bits / max(bits_per_gaussian, self.min_bits_per_gaussian)
        return min(max(1, round(count)), pixels)

    def min_sigma(self, num_gaussians: int, pixels: int) -> float:
        """Return the least standard deviation of a Gaussian in pixels: thin Gaussians look like stray strokes."""
        return self.width_per_spacing * max(0.0, math.sqrt(pixels / num_gaussians) - self.least_spacing)


# rounding lowers MS-SSIM more than fewer Gaussians do; the least width avoids visible stray strokes
BUDGETS: dict[ObjectiveName, GaussianBudget] = {
    "l2": GaussianBudget(),
    "ms-ssim": GaussianBudget(
        bits_per_gaussian=28.5,
        min_bits_per_gaussian=29.0,
        least_spacing=8.0,
        fit_iterations=500,
        compress_iterations=400,
    ),
}

# These numbers are tuned: change one and compare the files of `python -m benchmarks rate`, which have the same size.

# share of a fit's schedule that is run; the descent of `compress` replaces the rest. More: slower
_FIT_SHARE = 0.845
# the same share with a label map; at least 0.88, where contours move for the last time
_FIT_SHARE_WITH_REGIONS = 0.89
# iterations of a trial fit. More: slower, and its error predicts that of the whole fit better
_TRIAL_ITERATIONS = 80
# squared error after the whole fit, as a share of the error after a trial. More: contours must save more error
_FINAL_ERROR_SHARE = 0.65
# e in "squared error ~ bytes^-e", the slope of the rate-distortion curve. More: contours must save more error
_RATE_EXPONENT = 0.93
# share of all iterations that the few Gaussians of a reduced photo take. More: slower
_REDUCED_SHARE = 0.7
# least standard deviation of the Gaussians on a reduced photo, in its pixels. More: slower, and finer details
_PIXELS_PER_SIGMA = 1.5


@brief
class FitBytesResult(NamedTuple):
    """A file, the scene that it decodes to, and the fit before rounding.

    If the fit was on a reduced photo, the PSNR of its history is that of the reduced photo.
    """

    data: bytes
    scene: Scene
    result: FitResult


class _RegionChoice(NamedTuple):
    """The regions that save more error than their bytes cost."""

    regions: RegionMap | None
    num_gaussians: int  # number for the bytes that the map leaves
    contour_cost: float  # squared error that a pixel of contour must save
    changes: dict[str, Any]  # arguments of `report_regions`


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
    check_count("target_bytes", target_bytes, _MIN_BYTES)
    problem = make_problem(image, regions, 1, config, seed, purpose="file of a size")
    with Progress("trial fits", pulse=True, visible=progress), threads_for_kernels(problem.target[0, 0].numel()):
        choice = _choose_regions(problem, target_bytes)
    reduced = _reduce(problem, choice)
    share = _FIT_SHARE if choice.regions is None else _FIT_SHARE_WITH_REGIONS
    result = _fit_share(share, reduced, on_step, progress)
    scene = _enlarge(result.scene, problem.size)
    report = None if problem.regions is None else report_regions(problem.regions, scene, **choice.changes)
    with Progress("writing the file", pulse=True, visible=progress), threads_for_kernels(reduced.target[0, 0].numel()):
        objective = reduced.make_objective(reduced.target[0].to("cpu", torch.float32))
        min_sigma = _min_sigma(problem, choice.num_gaussians)
        iterations = _shorten(_budget(problem.config).compress_iterations, reduced.reduction)
        compressor = Compressor(SceneWriter(scene), objective, iterations, seed, min_sigma)
        data = compressor.search_bytes(target_bytes)
    return FitBytesResult(data, decode(data).scene, result._replace(scene=scene, regions=report))


def _budget(config: FitConfig) -> GaussianBudget:
    assert config.objective is not None
    return BUDGETS[config.objective]


def _reduce(problem: Problem, choice: _RegionChoice) -> Problem:
    """Return the problem of the fit; without a map, the photo is reduced as far as the least width allows."""
    config, (height, width) = problem.config, problem.size
    budget, min_sigma = _budget(config), _min_sigma(problem, choice.num_gaussians)
    reduction = _reduction(min_sigma) if choice.regions is None else 1
    update: dict[str, Any] = {"contour_cost": choice.contour_cost, "min_sigma": min_sigma / reduction}
    if config.iterations is None and config.max_seconds is None:
        update["iterations"] = _shorten(budget.fit_iterations, reduction)
    config = config.model_copy(update=update)
    return replace(
        problem, target=area_mean(problem.target, (-(-height // reduction), -(-width // reduction))),
        regions=choice.regions, num_gaussians=choice.num_gaussians, config=config, reduction=reduction,
    )  # fmt: skip


def _min_sigma(problem: Problem, num_gaussians: int) -> float:
    """Return the least standard deviation of `num_gaussians` Gaussians, in pixels of the photo."""
    config, pixels = problem.config, problem.size[0] * problem.size[1]
    return max(config.min_sigma, _budget(config).min_sigma(num_gaussians, pixels))


def _reduction(min_sigma: float) -> int:
    """Return the factor by which a photo may be reduced if no Gaussian is thinner than `min_sigma`."""
    return max(1, int(min_sigma / _PIXELS_PER_SIGMA))


def _shorten(iterations: int, reduction: int) -> int:
    return iterations if reduction == 1 else round(_REDUCED_SHARE * iterations)


def _enlarge(scene: Scene, size: tuple[int, int]) -> Scene:
    """Scale the scene of a reduced photo to the size of the photo."""
    if scene.size == size:
        return scene
    field = scene.field
    means, cholesky = scaled_gaussians(field, size)
    return Scene(GaussianField(means, cholesky, field.colors, opacities=field.opacities, size=size))


def _choose_regions(problem: Problem, target_bytes: int) -> _RegionChoice:
    """Merge regions whose contours save too little for their bytes; drop the map if it saves too little as a whole."""
    image, regions, config = problem.target[0], problem.regions, problem.config
    num_gaussians = partial(_budget(config).num_gaussians, pixels=image.shape[1] * image.shape[2])
    choice = _RegionChoice(None, num_gaussians(target_bytes), config.contour_cost, {})
    if not config.guidance:
        return choice._replace(changes={"dropped": "recipe"})
    if regions is None or regions.num_regions == 1:
        return choice
    map_bytes = _map_bytes(regions)
    if not config.merge_regions:
        if target_bytes < map_bytes + _MIN_BYTES:
            expected = f"at least {map_bytes + _MIN_BYTES} for this map, whose regions are kept"
            raise InvalidArgument("target_bytes", expected, target_bytes)
        return choice._replace(regions=regions, num_gaussians=num_gaussians(target_bytes - map_bytes))
    if _reduction(_min_sigma(problem, choice.num_gaussians)) > 1:
        return choice._replace(changes={"dropped": "bytes"})
    # trials are limited by iterations, not by time, so that the same arguments give the same file
    iterations = min(_TRIAL_ITERATIONS, config.planned_iterations)
    trial_config = FitConfig.from_recipe(
        config, merge_regions=False, iterations=iterations, max_seconds=None, objective="l2"
    )
    trial = replace(problem, config=trial_config)

    def trial_error(regions: RegionMap | None, count: int) -> Tensor:
        scene = _fit_share(_FIT_SHARE, replace(trial, regions=regions, num_gaussians=count)).scene
        return (scene.render() - image).square().mean(0)

    plain_error = trial_error(None, choice.num_gaussians)
    # squared error, summed over pixels, that one more bit of Gaussians saves: the derivative of the power law
    bit_value = _RATE_EXPONENT * _FINAL_ERROR_SHARE * float(plain_error.sum()) / (8 * target_bytes)
    contour_cost = bit_value * (8 * map_bytes / max(len(contour_edges(regions.labels)[0]), 1))
    paying_regions = regions
    if regions.softness == 0.0:
        paying_regions = RegionMap(merge_regions(image, regions.labels, contour_cost))
    choice = choice._replace(changes={"merged_for_bytes": regions.num_regions - paying_regions.num_regions})
    max_regions = num_gaussians(target_bytes - _map_bytes(paying_regions))
    candidate = paying_regions.merge(pairs_to_merge(image, paying_regions.labels, max_regions))[0]
    if candidate is None or candidate.num_regions == 1:
        return choice
    count = num_gaussians(target_bytes - _map_bytes(candidate))
    if count >= candidate.num_regions:
        rise = trial_error(candidate, count) - plain_error
        if rise.mean() < 0 and rise[edge_band(candidate.labels)].mean() < 0:
            return choice._replace(regions=candidate, num_gaussians=count, contour_cost=contour_cost)
    return choice._replace(changes={"dropped": "bytes"})


def _map_bytes(regions: RegionMap) -> int:
    """Return the size of the label map in a file, in bytes."""
    return 0 if regions.num_regions == 1 else len(encode_region_map(regions))


def _fit_share(
    share: float,
    problem: Problem,
    on_step: Callable[[int, HistoryEntry], bool | None] | None = None,
    progress: bool = False,
) -> FitResult:
    """Run the first share of a fit's schedule; the whole schedule in a fit with a clock."""
    config = problem.config
    until = 1.0 if config.max_seconds else math.ceil(share * config.planned_iterations) / config.planned_iterations
    return fit_problem(problem, on_step, progress, until=until)
