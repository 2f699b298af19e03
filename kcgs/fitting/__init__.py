"""An image in, a scene out."""

from .config import FitConfig, available_recipes
from .loop import fit
from .region_report import RegionReport
from .state import FitResult, HistoryEntry
from .warm_up import warm_up

__all__ = ["FitConfig", "FitResult", "HistoryEntry", "RegionReport", "available_recipes", "fit", "warm_up"]
