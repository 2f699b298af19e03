"""An image in, a scene out."""

from .config import FitConfig, available_recipes
from .initial import initial_field
from .loop import fit, precompile
from .pursuit import propose_gaussians
from .region_report import RegionReport
from .removal import Removal, lowest_impact
from .result import FitResult, HistoryEntry

__all__ = [
    "FitConfig", "FitResult", "HistoryEntry", "RegionReport", "Removal", "available_recipes", "fit", "initial_field",
    "lowest_impact", "precompile", "propose_gaussians",
]  # fmt: skip
