"""kcgs: contour-aware 2D Gaussian splatting of images, as differentiable torch modules."""

from . import _interrupts as _interrupts  # first: the others take seconds to load
from .evaluate import evaluate
from .fit import FitConfig, FitResult, fit
from .functional import RegionMap
from .nn import GaussianField, RegionSplatRenderer
from .scene import Scene, load, save

__version__ = "0.1.0"

__all__ = [
    "FitConfig", "FitResult", "GaussianField", "RegionMap", "RegionSplatRenderer", "Scene", "__version__",
    "evaluate", "fit", "load", "save",
]  # fmt: skip
