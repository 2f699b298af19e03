"""The optimizers of a fit by their names, with all that differs between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from kcgs.nn import GaussianField
from kcgs.optim import COLOR_LEARNING_RATE, LEARNING_RATE, GaussianAdam, cosine_decay

from .config import FitConfig
from .problem import Problem
from .published.gaussian_image import GaussianImageAdan
from .published.image_gs import ImageGSAdam


class OptimizerKind(NamedTuple):
    """An optimizer, and how a fit uses it."""

    make_optimizer: Callable[[FitConfig, GaussianField, float], Any]
    """For Gaussians that begin so many pixels wide."""
    rate: Callable[[float], float]
    """Factor of the learning rates, by progress."""
    has_drafts: bool
    """True where most of a fit renders with a larger cutoff."""
    keeps_averages: bool
    """True where averages stay when Gaussians are added or removed, so that a fit may go on from a finished one."""


def optimizer_kind(problem: Problem) -> OptimizerKind:
    """Return the kind that the settings name, or one around a user's function from a field to an optimizer."""
    make = problem.objects.optimizer
    if make is not None:
        return OptimizerKind(lambda config, field, sigma: make(field), cosine_decay, True, True)
    return _KINDS[problem.config.optimizer]


def _gaussian_adam(config: FitConfig, field: GaussianField, sigma: float) -> Any:
    factor = config.learning_rate_factor
    return GaussianAdam(
        field,
        LEARNING_RATE * factor,
        color_lr=COLOR_LEARNING_RATE * factor,
        min_sigma=config.min_sigma,
        bounded=config.bounded,
    )


def _adan(config: FitConfig, field: GaussianField, sigma: float) -> Any:
    return GaussianImageAdan(field, sigma, config.planned_iterations, config.learning_rate_factor)


def _adam(config: FitConfig, field: GaussianField, sigma: float) -> Any:
    return ImageGSAdam(field, config.learning_rate_factor)


_KINDS = {
    "gaussian-adam": OptimizerKind(_gaussian_adam, cosine_decay, True, True),
    "adan": OptimizerKind(_adan, GaussianImageAdan.rate, False, False),
    "adam": OptimizerKind(_adam, lambda progress: 1.0, False, False),
}
