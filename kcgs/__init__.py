"""kcgs: contour-aware 2D Gaussian splatting of images, as differentiable torch modules."""

from . import _interrupts as _interrupts  # first: the others take seconds to load
from .clip import Clip
from .evaluate import evaluate
from .fit import FitConfig, FitResult, fit
from .functional import RegionMap
from .nn import GaussianField, RegionSplatRenderer
from .rate.video import fit_video
from .scene import Scene, load, save

__version__ = "0.1.0"

__all__ = [
    "Clip", "FitConfig", "FitResult", "GaussianField", "RegionMap", "RegionSplatRenderer", "Scene", "__version__",
    "evaluate", "fit", "fit_video", "load", "save",
]  # fmt: skip
