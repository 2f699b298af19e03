"""Modules: a set of Gaussians, the renderer that renders it; pruning."""

from .field import GaussianField
from .prune import PruneResult, prune
from .renderer import RegionSplatRenderer

__all__ = [
    "GaussianField",
    "PruneResult",
    "RegionSplatRenderer",
    "prune",
]
