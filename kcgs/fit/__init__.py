"""An image in, a field out."""

from .config import FitConfig, available_recipes
from .loop import fit
from .monitor import FitResult, HistoryEntry
from .warm_up import warm_up

__all__ = [
    "FitConfig",
    "FitResult",
    "HistoryEntry",
    "available_recipes",
    "fit",
    "warm_up",
]
