"""The choice of the regions that a file of a size keeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

from torch import Tensor

from kcgs.codec import encode_region_map
from kcgs.errors import InvalidArgument
from kcgs.fitting import Problem, fit_problem
from kcgs.functional import merge_regions
from kcgs.maps import RegionMap, contour_edges, edge_band, pairs_to_merge

from .budget import FIT_SHARE, budget_of, min_sigma_of, reduction_of

# least size of a file: one Gaussian without a map
MIN_BYTES = 40

# These numbers are tuned: change one and compare the files of `python -m benchmarks rate`, which have the same size.

# iterations of a trial fit. More: slower, and its error predicts that of the whole fit better
_TRIAL_ITERATIONS = 80
# squared error after the whole fit, as a share of the error after a trial. More: contours must save more error
_FINAL_ERROR_SHARE = 0.65
# e in "squared error ~ bytes^-e", the slope of the rate-distortion curve. More: contours must save more error
_RATE_EXPONENT = 0.93


class RegionChoice(NamedTuple):
    """The regions that a file keeps, and what became of the others."""

    regions: RegionMap | None
    num_gaussians: int  # number for the bytes that the map leaves
    contour_cost: float  # squared error that a pixel of contour must save
    merged_for_bytes: int = 0  # as in RegionReport
    dropped: Literal["recipe", "bytes"] | None = None  # as in RegionReport


def choose_regions(problem: Problem, target_bytes: int) -> RegionChoice:
    """Choose the regions whose contours save more error than Gaussians of the same bytes.

    Settings, or few bytes, may decide without a fit; `problem.num_gaussians` is not used.
    """
    regions, config = problem.regions, problem.config
    no_map = RegionChoice(None, _num_gaussians(problem, target_bytes), config.contour_cost)
    if not config.guidance:
        return no_map._replace(dropped="recipe")
    if regions is None or regions.num_regions == 1:
        return no_map
    if not config.merge_regions:
        return _keep_map(problem, regions, target_bytes)
    if reduction_of(min_sigma_of(problem, no_map.num_gaussians)) > 1:
        return no_map._replace(dropped="bytes")
    return _choose_by_trials(no_map, problem, regions, target_bytes)


def _keep_map(problem: Problem, regions: RegionMap, target_bytes: int) -> RegionChoice:
    """Keep the whole map; refuse a size without room for it."""
    least = _map_bytes(regions) + MIN_BYTES
    if target_bytes < least:
        raise InvalidArgument("target_bytes", f"at least {least} for this map, whose regions are kept", target_bytes)
    return RegionChoice(regions, _num_gaussians(problem, target_bytes, regions), problem.config.contour_cost)


def _choose_by_trials(no_map: RegionChoice, problem: Problem, regions: RegionMap, target_bytes: int) -> RegionChoice:
    """Merge regions that cost more than they save; compare trial fits without a map and with the rest of the map."""
    image = problem.target[0]
    plain_error = _trial_error(problem, None, no_map.num_gaussians)
    # squared error, summed over pixels, that one more bit of Gaussians saves: the derivative of the power law
    bit_value = _RATE_EXPONENT * _FINAL_ERROR_SHARE * float(plain_error.sum()) / (8 * target_bytes)
    contour_cost = bit_value * (8 * _map_bytes(regions) / max(len(contour_edges(regions.labels)[0]), 1))
    paying_regions = regions
    if regions.softness == 0.0:
        paying_regions = RegionMap(merge_regions(image, regions.labels, contour_cost))
    merged_for_bytes = regions.num_regions - paying_regions.num_regions
    max_regions = _num_gaussians(problem, target_bytes, paying_regions)
    candidate = paying_regions.merge(pairs_to_merge(image, paying_regions.labels, max_regions))[0]
    if candidate is None:
        return no_map._replace(merged_for_bytes=merged_for_bytes)
    num_gaussians = _num_gaussians(problem, target_bytes, candidate)
    if num_gaussians >= candidate.num_regions:
        rise = _trial_error(problem, candidate, num_gaussians) - plain_error
        if rise.mean() < 0 and rise[edge_band(candidate.labels)].mean() < 0:
            return RegionChoice(candidate, num_gaussians, contour_cost, merged_for_bytes)
    return no_map._replace(dropped="bytes")


def _trial_error(problem: Problem, regions: RegionMap | None, num_gaussians: int) -> Tensor:
    """Return the squared error of each pixel after a short fit, (H, W).

    Iterations limit it, not time, so that the same arguments give the same file.
    """
    iterations = min(_TRIAL_ITERATIONS, problem.config.planned_iterations)
    update = {"merge_regions": False, "iterations": iterations, "max_seconds": None, "objective": "l2"}
    config = problem.config.model_copy(update=update)
    trial = replace(problem, regions=regions, num_gaussians=num_gaussians, config=config)
    scene = fit_problem(trial, until=FIT_SHARE).scene
    return (scene.render() - problem.target[0]).square().mean(0)


def _num_gaussians(problem: Problem, target_bytes: int, regions: RegionMap | None = None) -> int:
    """Return the number of Gaussians for the bytes that a map leaves."""
    height, width = problem.size
    return budget_of(problem.config).num_gaussians(target_bytes - _map_bytes(regions), height * width)


def _map_bytes(regions: RegionMap | None) -> int:
    """Return the size of a label map in a file, in bytes."""
    return 0 if regions is None or regions.num_regions == 1 else len(encode_region_map(regions))
