"""Modules: a set of Gaussians, and the renderer that renders it."""

from .field import GaussianField
from .renderer import RegionSplatRenderer

__all__ = ["GaussianField", "RegionSplatRenderer"]
