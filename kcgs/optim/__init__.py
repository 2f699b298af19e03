"""Optimizers of Gaussians."""

from .gaussian_adam import GaussianAdam

__all__ = ["GaussianAdam"]
