"""kcgs: contour-aware 2D Gaussian splatting of images, as differentiable torch modules."""

from .fit import FitConfig, FitResult, fit
from .functional import RegionMap
from .io import Scene, load, save
from .nn import GaussianField, RegionSplatRenderer

__version__ = "0.1.0"

__all__ = [
    "FitConfig",
    "FitResult",
    "GaussianField",
    "RegionMap",
    "RegionSplatRenderer",
    "Scene",
    "__version__",
    "fit",
    "load",
    "save",
]
