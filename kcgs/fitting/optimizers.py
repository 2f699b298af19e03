"""The optimizer of a fit, by its name or from a user's function."""

from __future__ import annotations

from collections.abc import Callable

from kcgs.nn import GaussianField
from kcgs.optim import COLOR_LEARNING_RATE, LEARNING_RATE, FieldOptimizer, GaussianAdam

from .config import FitConfig
from .problem import Problem
from .published.gaussian_image import GaussianImageAdan
from .user_objects import check_optimizer


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
