"""Modules: a set of Gaussians, and the renderer that renders it."""

from .field import GaussianField, join, pad_rows, scaled_gaussians
from .renderer import RegionSplatRenderer, area_mean, rendered_size

# public; what else is imported here is for the other rooms of kcgs
__all__ = ["GaussianField", "RegionSplatRenderer"]
