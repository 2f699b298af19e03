"""An image in, a file of so many bytes out: how many Gaussians, how finely rounded, and whether contours pay."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count
from kcgs._progress import Progress
from kcgs._repr import brief
from kcgs.errors import InvalidArgument
from kcgs.fitting import FitConfig, FitResult, HistoryEntry, fit
from kcgs.fitting.loop import check_problem
from kcgs.fitting.region_report import report_regions
from kcgs.functional import RegionMap, merge_regions
from kcgs.functional.labels import contour_edges
from kcgs.functional.merging import pairs_to_merge
from kcgs.kernels import image_threads_for_kernels
from kcgs.scene import Scene

from .compress import compress

# bits per Gaussian that is fitted, some of which are left out, at `_COUNT` of them, and for each doubling; what was
# lost to rounding shows more to the eye than Gaussians that are left out
_BITS = {"psnr": 25.2, "ms-ssim": 28.5}
_COUNT, _BITS_PER_OCTAVE = 2100, 1.9
_HEADER_BYTES = 60
# squared error falls with the power of the bytes
_POWER = 0.93
# contours show: an image with them may have this much more squared error, 0.1 dB
_FAVOUR = 1.023
_TRIAL_ITERATIONS, _TRIAL_TO_END = 80, 0.65
# share of its length that is left of a fit: the rest is for the last digits, which the descent on bits sees to, but for
# the last move of contours; not where Gaussians are so few that they may be refined
_FIT_END, _CONTOURS_END, _FEW = 0.845, 0.89, 64
# shares of the clock: each of two trials, and the fit of what is left then
_TRIAL_SHARE, _FIT_SHARE = 0.08, 0.75
_Choice = tuple[RegionMap | None, float, dict[str, Any]]


@brief
class FitBytesResult(NamedTuple):
    """A file, the scene that it decodes to, and the fit that it was made from, before rounding."""

    data: bytes
    scene: Scene
    result: FitResult


def fit_bytes(
    image: Any,
    regions: RegionMap | Tensor | NDArray[Any] | None = None,
    num_bytes: int = 8000,
    *,
    recipe: str | FitConfig = "best",
    seed: int = 0,
    on_step: Callable[[int, HistoryEntry], bool | None] | None = None,
    progress: bool = False,
    **settings: Any,
) -> FitBytesResult:
    """Fit an image to a budget of bytes, everything included.

    One trade decides: what the last bit saves. The number of Gaussians is that at which another one, or more digits
    for all, would save as much. A pixel of contour must save what the bits that the coder needs for it would save as
    Gaussians, else it moves or its regions are merged. The map as a whole stays only where two short fits, with it and
    with Gaussians for its bytes, say so, within 0.1 dB. With ``merge_regions=False`` no region goes. ``result.regions``
    says what became of the map.

    Args:
        image: as in :func:`kcgs.fit`.
        regions: as there.
        num_bytes: the file is not larger.
        recipe: as there.
        seed: as there.
        on_step: as there, for the fit itself, not the trials.
        progress: as there.
        settings: as there; `contour_cost` is replaced by the coder's, and `max_seconds` is for the fit alone. Without
            it the descent on bits replaces the last iterations, 11 or 15 %.

    Returns:
        The file, what it decodes to, and the fit.

    Raises:
        TypeError, ValueError: as :func:`kcgs.fit`; a budget too small for a Gaussian and the map.

    Example:
        >>> import torch
        >>> image = torch.linspace(0, 1, 48).expand(3, 32, 48)
        >>> done = fit_bytes(image, None, 200, iterations=50)
        >>> len(done.data) <= 200, done.scene.regions
        (True, None)
    """
    config = FitConfig.from_recipe(recipe, **settings)
    image, regions = check_problem(image, regions)
    check_count("num_bytes", num_bytes)
    if config.target_psnr is not None:
        raise InvalidArgument("target_psnr", "None where bytes are the target", config.target_psnr)
    with Progress("trial fits", known=False, shown=progress):
        chosen, cost, changes = _choose(image, regions, num_bytes, config, seed)
    count = count_for(num_bytes - _map_bytes(chosen), image.shape[1] * image.shape[2], config.objective)

    config = config.model_copy(update={"contour_cost": cost})
    share = _FIT_END if chosen is None else _CONTOURS_END
    last = math.inf if config.max_seconds else math.ceil(share * config.usual_iterations)

    def step(iteration: int, entry: HistoryEntry) -> bool:
        return (on_step is not None and bool(on_step(iteration, entry))) or iteration >= last

    result = fit(image, chosen, count, recipe=config, seed=seed, on_step=step, progress=progress)
    changes = changes if config.guidance else {"dropped": "recipe"}
    result = result._replace(regions=report_regions(regions, result.scene, **changes))
    if result.history[-1].iteration >= last:
        result = result._replace(stop_reason="iterations")
    with Progress("writing the file", known=False, shown=progress):
        data, scene = compress(result.scene, image, target_bytes=num_bytes, seed=seed, objective=config.objective)
    return FitBytesResult(data, scene, result)


def count_for(num_bytes: float, pixels: int, objective: str = "psnr") -> int:
    """Return how many Gaussians make the best of so many bytes, at most one for each pixel."""
    bits = 8 * max(num_bytes - _HEADER_BYTES, 1)
    count = bits / _BITS[objective]
    for _ in range(4):
        count = bits / max(_BITS[objective] + _BITS_PER_OCTAVE * math.log2(max(count, 1.0) / _COUNT), 8.0)
    return min(max(1, round(count)), pixels)


@image_threads_for_kernels
def _choose(image: Tensor, regions: RegionMap | None, num_bytes: int, config: FitConfig, seed: int) -> _Choice:
    """Choose the regions that pay for their bytes; return what a pixel of contour must save, and what went, too."""
    if regions is None or regions.num_regions == 1 or not config.guidance:
        return None, config.contour_cost, {}
    if not config.merge_regions:
        return regions, config.contour_cost, {}
    given = regions.num_regions
    count_of = partial(count_for, pixels=image.shape[1] * image.shape[2], objective=config.objective)
    # by iterations, so that without a clock the same arguments give the same file
    iterations = min(_TRIAL_ITERATIONS, config.usual_iterations)
    trial = FitConfig.from_recipe(config, merge_regions=False, iterations=iterations, max_seconds=None)

    def error(regions: RegionMap | None, left: int) -> float:
        end = math.ceil(_FIT_END * iterations)
        result = fit(image, regions, count_of(left), recipe=trial, seed=seed, on_step=lambda i, _: i >= end)
        return float(10 ** (-max(entry.psnr for entry in result.history) / 10))

    without = error(None, num_bytes)
    # what a bit saves, where it is spent on Gaussians
    saved = _POWER * _TRIAL_TO_END * without * image[0].numel() / (8 * num_bytes)
    # a pixel of contour must save what its bits would
    bits = 8 * _map_bytes(regions) / max(len(contour_edges(regions.labels)[0]), 1)
    cost = saved * bits
    if regions.softness == 0.0:
        regions = RegionMap.from_labels(merge_regions(image, regions.labels, cost))
    paying, count = regions.num_regions, count_of(num_bytes - _map_bytes(regions))
    if paying > count:
        regions = regions.merge(pairs_to_merge(image, regions.labels, count))[0]
    kept = 1 if regions is None else regions.num_regions
    merged = {"merged_for_bytes": given - paying}
    if regions is None or kept == 1:
        return None, cost, merged
    left = num_bytes - _map_bytes(regions)
    if count_of(left) < kept or error(regions, left) >= _FAVOUR * without:
        return None, cost, {"dropped": "bytes"}
    return regions, cost, merged


def _map_bytes(regions: RegionMap | None) -> int:
    if regions is None or regions.num_regions == 1:
        return 0
    from kcgs.codec.labels import encode_map  # loads numba

    return len(encode_map(regions))
