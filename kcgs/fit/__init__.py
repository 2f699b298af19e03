"""An image in, a scene out."""

from .config import FitConfig, available_recipes
from .loop import fit
from .state import FitResult, HistoryEntry
from .warm_up import warm_up

__all__ = ["FitConfig", "FitResult", "HistoryEntry", "available_recipes", "fit", "warm_up"]
