"""The optimizers of a fit: ours, and those of published methods."""

from __future__ import annotations

import math

from kcgs.fitting.config import FitConfig
from kcgs.nn import GaussianField
from kcgs.optim import GaussianAdam
from kcgs.optim.gaussian_adam import COLOR_LEARNING_RATE, LEARNING_RATE

from .adan import Adan
from .gaussian_image import GaussianImageAdan
from .image_gs import ImageGSAdam
from .published import PublishedOptimizer

__all__ = [
    "Adan", "GaussianImageAdan", "GaussianOptimizer", "ImageGSAdam", "cosine_decay",
    "make_optimizer", "set_learning_rates",
]  # fmt: skip

GaussianOptimizer = GaussianAdam | PublishedOptimizer

# learning rate at the end of a fit by GaussianAdam, in units of that at its start
_FINAL_DECAY = 0.1
# GaussianImage halves its rates after each such share of a fit
_HALF_LIFE = 0.4


def make_optimizer(config: FitConfig, field: GaussianField, sigma: float) -> GaussianOptimizer:
    """Return the optimizer that the config names, for Gaussians that began `sigma` pixels wide."""
    factor = config.learning_rate_factor
    if config.optimizer == "adan":
        return GaussianImageAdan(field, sigma, config.usual_iterations, factor)
    if config.optimizer == "adam":
        return ImageGSAdam(field, factor)
    optimizer = GaussianAdam(
        field, LEARNING_RATE * factor, color_lr=COLOR_LEARNING_RATE * factor, min_sigma=config.min_sigma
    )
    for group in optimizer.param_groups:
        group["initial_lr"] = group["lr"]
    return optimizer


def set_learning_rates(optimizer: GaussianOptimizer, config: FitConfig, progress: float) -> None:
    """Set the learning rates for when this share of the fit is over."""
    factor = 1.0
    if config.optimizer == "adan":
        factor = 0.5 ** int(progress / _HALF_LIFE)
    elif config.optimizer == "gaussian-adam":
        factor = cosine_decay(progress)
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * factor


def cosine_decay(progress: float) -> float:
    """Return a factor that falls along a cosine from 1 to a tenth."""
    cosine = 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
    return _FINAL_DECAY + (1 - _FINAL_DECAY) * cosine
