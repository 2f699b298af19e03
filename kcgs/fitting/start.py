"""The state at the start of a fit: the map to render with, the first Gaussians, and their optimizer."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from kcgs.functional import RegionMap, choose_softness
from kcgs.maps import pairs_to_merge
from kcgs.nn import GaussianField
from kcgs.optim import Renderer, draft_cutoff

from .config import FitConfig
from .initial import initial_sigma, random_field, uniform_field
from .optimizers import optimizer_kind
from .problem import Problem
from .published.gradient_start import gradient_field
from .state import FitState

_INITIALIZERS = {"uniform": uniform_field, "random": random_field, "gradient": gradient_field}


def start(problem: Problem) -> FitState:
    """Return the state of a fit at its start."""
    image, config = problem.canvas, problem.config
    regions = _regions_to_render(image, _as_many_as_gaussians(problem), config)
    share = math.ceil(config.densify_from * problem.num_gaussians)
    count = min(problem.num_gaussians, max(1 if regions is None else regions.num_regions, share))
    field = _INITIALIZERS[config.initializer](image, count, regions, problem.seed)
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


def _as_many_as_gaussians(problem: Problem) -> RegionMap | None:
    """Merge regions, where the config lets them merge, until each can have a Gaussian: others would be black."""
    regions, count = problem.regions, problem.num_gaussians
    if regions is None or not problem.config.merge_regions or regions.num_regions <= count:
        return regions
    return regions.merge(pairs_to_merge(problem.canvas, regions.labels, count))[0]


def _regions_to_render(image: Tensor, regions: RegionMap | None, config: FitConfig) -> RegionMap | None:
    if regions is None or not config.guidance or regions.num_regions == 1:
        return None
    # a map with softness of its own knows how sharp its contours are
    if regions.softness != 0.0 or config.softness == 0.0:
        return regions
    if config.softness != "auto":
        return RegionMap.from_labels(regions.labels, config.softness)
    labels = regions.labels.cpu()
    return RegionMap.from_labels(labels, choose_softness(image, labels)).to(image.device)
