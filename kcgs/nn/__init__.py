"""Modules: a set of Gaussians, the renderer that draws it, pruning, and editing by region."""

from .editing import EditedScene, delete_region, extract_region, move_region, recolor_region, replace_background
from .field import GaussianField
from .prune import PruneResult, prune
from .renderer import RegionSplatRenderer

__all__ = [
    "EditedScene",
    "GaussianField",
    "PruneResult",
    "RegionSplatRenderer",
    "delete_region",
    "extract_region",
    "move_region",
    "prune",
    "recolor_region",
    "replace_background",
]
