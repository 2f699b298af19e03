"""Modules: a set of Gaussians, and the renderer that renders it."""

from .field import GaussianField
from .renderer import RegionSplatRenderer, area_mean, rendered_size
from .rows import clear_lost_rows, join, pad_rows, reorder_rows, scaled_gaussians, used_rows

# public; other packages of kcgs use the other imports
__all__ = ["GaussianField", "RegionSplatRenderer"]
