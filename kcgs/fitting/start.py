"""The state at the start of a fit: the map to render with, the first Gaussians, and their optimizer."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from kcgs.functional import RegionMap, choose_softness
from kcgs.maps import pairs_to_merge
from kcgs.nn import GaussianField
from kcgs.optim import Renderer, draft_cutoff

from .batch_maps import join_maps, map_of_each, regions_per_map
from .initial import initial_sigma, random_field, uniform_field
from .optimizers import optimizer_kind
from .problem import Problem
from .published.gradient_start import gradient_field
from .state import FitState

_INITIALIZERS = {"uniform": uniform_field, "random": random_field, "gradient": gradient_field}


def start(problem: Problem) -> FitState:
    """Return the state of a fit at its start."""
    config, regions = problem.config, _regions_to_render(problem)
    share = math.ceil(config.densify_from * problem.num_gaussians)
    count = min(problem.num_gaussians, max(1 if regions is None else max(regions_per_map(regions)), share))
    field = _INITIALIZERS[config.initializer](problem.canvas, count, regions, problem.seed)
    return make_state(problem, field, regions, count, anchor=regions)


def make_state(
    problem: Problem, field: GaussianField, regions: RegionMap | None, num_initial: int, **progress: Any
) -> FitState:
    """Return the state of a fit of a field that began with so many Gaussians."""
    config, kind = problem.config, optimizer_kind(problem)
    cutoff = draft_cutoff(config.cutoff) if kind.has_drafts else config.cutoff
    return FitState(
        field,
        kind.make_optimizer(config, field, initial_sigma(problem.size, num_initial)),
        problem.objective,
        Renderer(problem.size, regions, cutoff, config.backend, problem.bounds),
        problem=problem,
        num_initial=num_initial,
        **{"num_requested": num_initial, **progress},
    )


def _regions_to_render(problem: Problem) -> RegionMap | None:
    """Return the map of each image to render with; None where no image has more than one region."""
    if problem.regions is None or not problem.config.guidance:
        return None
    maps = map_of_each(problem.regions, problem.num_images)
    maps = [_map_to_render(image, one, problem) for image, one in zip(problem.canvas, maps, strict=True)]
    return None if all(one.num_regions == 1 for one in maps) else join_maps(maps)


def _map_to_render(image: Tensor, regions: RegionMap, problem: Problem) -> RegionMap:
    """Return the map of an image with softness, and with at most as many regions as Gaussians where regions merge."""
    config, count = problem.config, problem.num_gaussians
    if config.merge_regions and regions.num_regions > count:
        # until each region can have a Gaussian: others would be black
        merged, ids = regions.merge(pairs_to_merge(image, regions.labels, count))
        regions = RegionMap(ids[:1].expand(regions.size)) if merged is None else merged
    # a map with softness of its own knows how sharp its contours are
    if regions.num_regions == 1 or regions.softness != 0.0 or config.softness == 0.0:
        return regions
    if config.softness != "auto":
        return RegionMap.from_labels(regions.labels, config.softness)
    return with_chosen_softness(image, regions)


def with_chosen_softness(image: Tensor, regions: RegionMap) -> RegionMap:
    """Return a map of an image with the softness of each contour that explains the image best."""
    labels = regions.labels.cpu()
    return RegionMap.from_labels(labels, choose_softness(image, labels)).to(image.device)
