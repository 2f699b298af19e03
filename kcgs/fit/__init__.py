"""An image in, a field out."""

from .config import FitConfig, available_recipes
from .loop import FitResult, HistoryEntry, fit

__all__ = ["FitConfig", "FitResult", "HistoryEntry", "available_recipes", "fit"]
