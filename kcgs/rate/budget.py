"""A file of at most `target_bytes` from an image: the number of Gaussians, the regions, the fit, the rounding."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from torch import Tensor

from kcgs._check import check_count
from kcgs._progress import Progress
from kcgs._repr import brief
from kcgs.errors import InvalidArgument
from kcgs.fitting import FitConfig, FitResult, HistoryEntry, fit
from kcgs.fitting.problem import check_image_and_regions
from kcgs.fitting.region_report import report_regions
from kcgs.functional import RegionMap, edge_band, merge_regions
from kcgs.functional.labels import contour_edges
from kcgs.functional.merging import pairs_to_merge
from kcgs.kernels import image_threads_for_kernels
from kcgs.scene import Scene

from .compress import compress

# fixed-point iterations of the number of Gaussians, which the bits of one depend on
_COUNT_ITERATIONS = 4
# of a file of one Gaussian without a map
_MIN_BYTES = 40


@dataclass(frozen=True)
class GaussianBudget:
    """The number of Gaussians of the best file of so many bytes.

    More Gaussians leave fewer bits for each: the fit has less error, and rounding adds more. All fields are tuned.
    To tune one again, change it and compare the files of ``python -m benchmarks rate``, which are of one size.
    """

    bits_per_gaussian: float = 25.2
    """Bits of the file per Gaussian of the fit, at `reference_count`. More: fewer Gaussians, each rounded less."""
    reference_count: int = 2100
    """Number of Gaussians for which `bits_per_gaussian` holds: a file of 6,700 bytes."""
    bits_per_doubling: float = 1.9
    """More bits per Gaussian for each doubling of their number. More: small files get more Gaussians, large ones
    fewer."""
    min_bits_per_gaussian: float = 8.0
    """Bits per Gaussian, however few there are."""
    header_bytes: int = 60
    """Bytes of a file beside Gaussians and map."""

    def num_gaussians(self, target_bytes: float, pixels: int) -> int:
        """Return the number of Gaussians, from 1 to `pixels`, of a file of at most `target_bytes` without a map."""
        bits = 8 * max(target_bytes - self.header_bytes, 1)
        count = bits / self.bits_per_gaussian
        for _ in range(_COUNT_ITERATIONS):
            doublings = math.log2(max(count, 1.0) / self.reference_count)
            bits_per_gaussian = self.bits_per_gaussian + self.bits_per_doubling * doublings
            count = bits / max(bits_per_gaussian, self.min_bits_per_gaussian)
        return min(max(1, round(count)), pixels)


@dataclass(frozen=True)
class FitBytesSettings:
    """What a fit to so many bytes trades off: time, and contours against Gaussians.

    All fields are tuned. To tune one again, change it and compare the files of ``python -m benchmarks rate``.
    """

    fit_share: float = 0.845
    """Share of a fit's schedule that is run; the descent of `compress` does what the rest would do. More: slower."""
    fit_share_with_regions: float = 0.89
    """The same with a label map, whose contours move for the last time at 0.88: not below it."""
    trial_iterations: int = 80
    """Iterations of a trial fit. More: slower, and its error predicts that of the whole fit better."""
    final_error_share: float = 0.65
    """Squared error after the whole fit, as a share of that after a trial. More: contours must save more error."""
    rate_exponent: float = 0.93
    """e in "squared error ~ bytes^-e", the slope of the rate-distortion curve. More: contours must save more error."""


# MS-SSIM suffers more from rounding than from fewer Gaussians
BUDGETS = {"psnr": GaussianBudget(), "ms-ssim": GaussianBudget(bits_per_gaussian=28.5)}
_SETTINGS = FitBytesSettings()


@brief
class FitBytesResult(NamedTuple):
    """A file, the scene that it decodes to, and the fit that it was made from, before rounding."""

    data: bytes
    scene: Scene
    result: FitResult


class _RegionChoice(NamedTuple):
    """The regions that pay for their bytes."""

    regions: RegionMap | None
    num_gaussians: int  # for the bytes that the regions leave
    contour_cost: float  # squared error that a pixel of contour must save
    changes: dict[str, Any]  # for the report on the regions


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

    Convention: all bits save the same error at the margin. The number of Gaussians is that at which another Gaussian
    and finer rounding of all would save as much. A pixel of contour must save what its bits would save as Gaussians,
    else it moves or its regions are merged. The map as a whole is used if a short fit with it has less error than one
    with Gaussians for its bytes, in the image and along the contours. With ``merge_regions=False`` the whole map is
    used. ``result.regions`` reports the changes of the map.

    Args:
        image: as in :func:`kcgs.fit`.
        regions: as there.
        target_bytes: largest size of the file, at least 40.
        recipe: as there.
        seed: as there.
        on_step: as there, for the fit itself, not the trials.
        progress: as there.
        settings: as there; `contour_cost` is replaced by the coder's, and `max_seconds` is for the fit alone. Without
            it the rate-distortion descent replaces the last iterations, 11 or 15 %.

    Returns:
        The file, the scene that it decodes to, and the fit.

    Raises:
        TypeError, ValueError: as :func:`kcgs.fit`; `target_bytes` below 40, or too small for a map that is to be kept.

    Example:
        >>> import torch
        >>> image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> data, scene, _ = fit_bytes(image, None, 200, iterations=50)
        >>> len(data) <= 200, scene.regions
        (True, None)
    """
    config = FitConfig.from_recipe(recipe, **settings)
    image, regions = check_image_and_regions(image, regions)
    check_count("target_bytes", target_bytes, _MIN_BYTES)
    if config.target_psnr is not None:
        raise InvalidArgument("target_psnr", "None with target_bytes", config.target_psnr)
    with Progress("trial fits", pulse=True, visible=progress):
        choice = _choose_regions(image, regions, target_bytes, config, seed)
    config = config.model_copy(update={"contour_cost": choice.contour_cost})
    share = _SETTINGS.fit_share if choice.regions is None else _SETTINGS.fit_share_with_regions
    result = _fit_share(
        share, image, choice.regions, choice.num_gaussians, config, on_step, seed=seed, progress=progress
    )
    report = report_regions(regions, result.scene, **choice.changes)
    with Progress("writing the file", pulse=True, visible=progress):
        data, scene = compress(result.scene, image, target_bytes=target_bytes, seed=seed, objective=config.objective)
    return FitBytesResult(data, scene, result._replace(regions=report))


@image_threads_for_kernels
def _choose_regions(
    image: Tensor, regions: RegionMap | None, target_bytes: int, config: FitConfig, seed: int
) -> _RegionChoice:
    """Merge regions whose contours do not pay for their bytes, then drop the map if it does not pay as a whole."""
    num_gaussians = partial(BUDGETS[config.objective].num_gaussians, pixels=image.shape[1] * image.shape[2])
    choice = _RegionChoice(None, num_gaussians(target_bytes), config.contour_cost, {})
    if not config.guidance:
        return choice._replace(changes={"dropped": "recipe"})
    if regions is None or regions.num_regions == 1:
        return choice
    map_bytes = _map_bytes(regions)
    if not config.merge_regions:
        return choice._replace(regions=regions, num_gaussians=num_gaussians(target_bytes - map_bytes))
    # by iterations, so that without a clock the same arguments give the same file
    iterations = min(_SETTINGS.trial_iterations, config.usual_iterations)
    trial = FitConfig.from_recipe(config, merge_regions=False, iterations=iterations, max_seconds=None)

    def trial_error(regions: RegionMap | None, count: int) -> Tensor:
        scene = _fit_share(_SETTINGS.fit_share, image, regions, count, trial, seed=seed).scene
        return (scene.render() - image).square().mean(0)

    plain_error = trial_error(None, choice.num_gaussians)
    # squared error, summed over pixels, that one more bit of Gaussians saves: the derivative of the power law
    bit_value = _SETTINGS.rate_exponent * _SETTINGS.final_error_share * float(plain_error.sum()) / (8 * target_bytes)
    contour_cost = bit_value * (8 * map_bytes / max(len(contour_edges(regions.labels)[0]), 1))
    paying_regions = regions
    if regions.softness == 0.0:
        paying_regions = RegionMap.from_labels(merge_regions(image, regions.labels, contour_cost))
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
    """Return the bytes that the label map takes in a file."""
    if regions.num_regions == 1:
        return 0
    from kcgs.codec.region_map import encode_region_map  # loads numba

    return len(encode_region_map(regions))


def _fit_share(
    share: float,
    image: Tensor,
    regions: RegionMap | None,
    num_gaussians: int,
    config: FitConfig,
    on_step: Callable[[int, HistoryEntry], bool | None] | None = None,
    **settings: Any,
) -> FitResult:
    """Run the first share of a fit's schedule; all of it where a clock ends the fit."""
    last = math.inf if config.max_seconds else math.ceil(share * config.usual_iterations)

    def stop(iteration: int, entry: HistoryEntry) -> bool:
        return (on_step is not None and bool(on_step(iteration, entry))) or iteration >= last

    result = fit(image, regions, num_gaussians, recipe=config, on_step=stop, **settings)
    is_complete = result.history[-1].iteration >= last
    return result._replace(stop_reason="iterations") if is_complete else result
