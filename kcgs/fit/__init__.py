"""An image in, a field out."""

from .compress import Compressed, compress, fit_bytes
from .config import FitConfig, available_recipes
from .loop import fit
from .monitor import FitResult, HistoryEntry

__all__ = [
    "Compressed",
    "FitConfig",
    "FitResult",
    "HistoryEntry",
    "available_recipes",
    "compress",
    "fit",
    "fit_bytes",
]
