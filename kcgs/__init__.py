"""kcgs: contour-aware 2D Gaussian splatting of images, as differentiable torch modules."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import codec, data, editing, engine, fitting, functional, nn  # noqa: F401, I001
    from . import onnx, optim, page, rate, segment, video  # noqa: F401
    from .errors import InvalidArgument, InvalidArgumentType
    from .evaluation import evaluate
    from .files import load, save
    from .fitting import FitConfig, FitResult, fit
    from .maps import RegionMap
    from .nn import GaussianField, RegionSplatRenderer
    from .pruning import prune
    from .scene import Scene

__version__ = "0.4.0"

__all__ = [
    "FitConfig", "FitResult", "GaussianField", "InvalidArgument", "InvalidArgumentType", "RegionMap",
    "RegionSplatRenderer", "Scene", "__version__", "evaluate", "fit", "load", "prune", "save",
]  # fmt: skip

# Public names by module. A module is imported when one of its names is used, so that `kcgs --help` loads no torch.
_MODULES = {
    "errors": ("InvalidArgument", "InvalidArgumentType"),
    "evaluation": ("evaluate",),
    "files": ("load", "save"),
    "fitting": ("FitConfig", "FitResult", "fit"),
    "maps": ("RegionMap",),
    "nn": ("GaussianField", "RegionSplatRenderer"),
    "pruning": ("prune",),
    "scene": ("Scene",),
}
_PACKAGES = (
    "codec", "data", "editing", "engine", "fitting", "functional", "nn", "onnx", "optim", "page", "rate", "segment",
    "video",
)  # fmt: skip


if not TYPE_CHECKING:  # for a type checker, any name would exist

    def __getattr__(name: str) -> Any:
        if name in _PACKAGES:
            return import_module(f".{name}", __name__)
        for module, names in _MODULES.items():
            if name in names:
                return getattr(import_module(f".{module}", __name__), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_PACKAGES})
