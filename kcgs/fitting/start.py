"""The state at the start of a fit: the map to render with, the first Gaussians, and their optimizer."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcgs.functional import choose_softness
from kcgs.maps import RegionMap, pairs_to_merge
from kcgs.nn import GaussianField, pad_rows
from kcgs.optim import COLOR_LEARNING_RATE, LEARNING_RATE, FieldOptimizer, GaussianAdam, Renderer, draft_cutoff

from .config import FitConfig
from .gaussian_image import GaussianImageAdan
from .image_maps import join_maps, map_of_each, regions_per_map
from .initial import initial_sigma, random_field, uniform_field
from .problem import Problem
from .state import FitState
from .user_objects import check_initial, check_optimizer

_INITIALIZERS = {"uniform": uniform_field, "random": random_field}


def start(problem: Problem) -> FitState:
    """Return the state of a fit at its start."""
    regions, first = _regions_to_render(problem), math.ceil(problem.config.densify_from * problem.num_gaussians)
    # at least one Gaussian for each region of an image, but at most N
    num_regions = [1] * problem.num_images if regions is None else regions_per_map(regions)
    counts = [min(problem.num_gaussians, max(first, count)) for count in num_regions]
    field = _initial_field(problem, regions, counts)
    state = make_state(problem, field, regions, field.num_gaussians, anchor=regions)
    if min(counts) < field.num_gaussians:
        state.initial_counts = counts
        rows, numbers = torch.arange(field.num_gaussians), torch.tensor(counts)[:, None]
        state.optimizer.freeze(field, (rows >= numbers).to(problem.device))
    return state


def _initial_field(problem: Problem, regions: RegionMap | None, counts: list[int]) -> GaussianField:
    """Return `counts` Gaussians of the images, padded at the end with unused rows."""
    initialize = problem.objects.initializer or _INITIALIZERS[problem.config.initializer]
    images, most = problem.target, max(counts)

    def scatter(images: Tensor, count: int, regions: RegionMap | None) -> GaussianField:
        return check_initial(initialize(images, count, regions, problem.seed), images, count, regions)

    if regions is None or min(counts) == most:
        return scatter(images, most, regions)
    maps = map_of_each(regions, problem.num_images)
    fields = [
        pad_rows(scatter(image[None], count, one)[0], most, one)
        for image, count, one in zip(images, counts, maps, strict=True)
    ]
    return GaussianField.stack(fields)


def make_state(
    problem: Problem, field: GaussianField, regions: RegionMap | None, num_initial: int, **progress: Any
) -> FitState:
    """Return the state of a fit of a field that began with `num_initial` Gaussians."""
    config, optimizer = problem.config, make_optimizer(problem, field, initial_sigma(problem.size, num_initial))
    cutoff = draft_cutoff(config.cutoff) if optimizer.has_drafts else config.cutoff
    renderer = Renderer(problem.size, regions, cutoff, config.backend, problem.bounds)
    progress = {"num_requested": num_initial, **progress}
    return FitState(field, optimizer, problem.objective, renderer, problem=problem, num_initial=num_initial, **progress)


def make_optimizer(problem: Problem, field: GaussianField, sigma: float) -> FieldOptimizer:
    """Return the optimizer of a field whose Gaussians begin with `sigma`, in pixels."""
    if problem.objects.optimizer is not None:
        return check_optimizer(problem.objects.optimizer(field), problem.num_images)
    return _OPTIMIZERS[problem.config.optimizer](problem.config, field, sigma)


def _gaussian_adam(config: FitConfig, field: GaussianField, sigma: float) -> GaussianAdam:
    factor = config.learning_rate_factor
    rate, color_rate = LEARNING_RATE * factor, COLOR_LEARNING_RATE * factor
    return GaussianAdam(field, rate, color_lr=color_rate, min_sigma=config.min_sigma, bounded=config.bounded)


def _adan(config: FitConfig, field: GaussianField, sigma: float) -> GaussianImageAdan:
    return GaussianImageAdan(field, sigma, config.planned_iterations, config.learning_rate_factor)


_OPTIMIZERS: dict[str, Callable[[FitConfig, GaussianField, float], FieldOptimizer]] = {
    "gaussian-adam": _gaussian_adam,
    "adan": _adan,
}


def _regions_to_render(problem: Problem) -> RegionMap | None:
    """Return the map of each image to render with; None if no image has more than one region."""
    if problem.regions is None or not problem.config.guidance:
        return None
    maps = map_of_each(problem.regions, problem.num_images)
    maps = [_map_to_render(image, one, problem) for image, one in zip(problem.target, maps, strict=True)]
    return None if all(one.num_regions == 1 for one in maps) else join_maps(maps)


def _map_to_render(image: Tensor, regions: RegionMap, problem: Problem) -> RegionMap:
    """Return the map of an image with its softness, merged to at most N regions if the settings merge regions."""
    config, count = problem.config, problem.num_gaussians
    if config.merge_regions and regions.num_regions > count:
        # each region needs a Gaussian: without one it would be black
        merged, ids = regions.merge(pairs_to_merge(image, regions.labels, count))
        regions = RegionMap(ids[:1].expand(regions.size)) if merged is None else merged
    # the map's own softness takes precedence over the settings
    if regions.num_regions == 1 or regions.softness != 0.0 or config.softness == 0.0:
        return regions
    if config.softness != "auto":
        return RegionMap(regions.labels, config.softness)
    return with_chosen_softness(image, regions)


def with_chosen_softness(image: Tensor, regions: RegionMap) -> RegionMap:
    """Give each contour of a map the softness that explains the image best."""
    labels = regions.labels.cpu()
    return RegionMap(labels, choose_softness(image, labels)).to(image.device)
