"""An image in, a scene out."""

from .config import FitConfig, available_recipes
from .initial import initial_field
from .loop import fit, precompile
from .region_report import RegionReport
from .result import FitResult, HistoryEntry

__all__ = [
    "FitConfig", "FitResult", "HistoryEntry", "RegionReport", "available_recipes", "fit", "initial_field", "precompile",
]  # fmt: skip
