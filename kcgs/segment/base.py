"""What a segmenter is, and the segmenters by name."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_floating

_TOLERANCE = 1e-3
# packages that are called otherwise than what is imported
_PACKAGES = {"skimage": "scikit-image", "PIL": "pillow"}


class Segmenter(Protocol):
    """A function from an image to its regions.

    It takes (3, H, W) or (1, H, W) floating in [0, 1] and returns (H, W) int64 with ids 0 to R - 1, each in
    use, ordered by decreasing area; of equal areas, the region with the earlier first pixel comes first.
    """

    def __call__(self, image: Tensor) -> Tensor:
        """Return the label map of ``image``."""
        ...


_Function = TypeVar("_Function", bound=Callable[..., Tensor])
_methods: dict[str, Callable[..., Tensor]] = {}


def register(name: str) -> Callable[[_Function], _Function]:
    """Make a segmenter available to `segment` by a name.

    Args:
        name: a name not in use.

    Returns:
        A decorator that returns the segmenter unchanged. It may take keyword options beyond the image.

    Raises:
        ValueError: the name is empty or taken.

    Example:
        >>> import torch
        >>> @register("halves")
        ... def halves(image: Tensor) -> Tensor:
        ...     columns = torch.arange(image.shape[-1]) >= image.shape[-1] // 2
        ...     return columns.long().expand(image.shape[-2:])
        >>> segment(torch.zeros(3, 1, 4), method="halves").tolist()
        [[0, 0, 1, 1]]
        >>> del _methods["halves"]
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"name must be a non-empty string; got {name!r}")
    if name in _methods:
        raise ValueError(f"there is a segmentation method {name!r} already")

    def add(function: _Function) -> _Function:
        _methods[name] = function
        return function

    return add


def available_methods() -> list[str]:
    """Return the names that `segment` knows, sorted.

    Example:
        >>> "auto" in available_methods()
        True
    """
    return sorted(_methods)


def segment(image: Tensor, method: str = "auto", **options: object) -> Tensor:
    """Divide an image into regions by the named method.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1].
        method: one of `available_methods`.
        options: keyword arguments of that method.

    Returns:
        :math:`(H, W)` int64 on the device of ``image``, ids 0 to R - 1 by decreasing area.

    Raises:
        TypeError: ``image`` is no floating tensor, or the method has no such option.
        ValueError: ``method`` is unknown, or ``image`` has another shape, non-finite values or values outside
            [0, 1].
        ImportError: the method's library is not installed; the message has the line that installs it.

    Example:
        >>> import torch
        >>> image = torch.zeros(3, 40, 60)
        >>> image[:, :, 20:] = 1.0
        >>> segment(image)[0, ::20].tolist()
        [1, 0, 0]
    """
    if method not in _methods:
        raise ValueError(f"method must be one of {', '.join(available_methods())}; got {method!r}")
    with names_missing_library(method):
        return _methods[method](image, **options)


@contextmanager
def names_missing_library(used_by: str) -> Iterator[None]:
    """Let a library that is not installed raise an ImportError with the line that installs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module in ("", "kcgs"):
            raise
        package = _PACKAGES.get(module, module)
        raise ImportError(f"segmentation method {used_by!r} needs {module}: pip install {package} ({error})") from error


def check_segment_image(image: object) -> NDArray[np.float32]:
    """Return a checked image as (H, W, 3) in [0, 1], grey repeated.

    Values may pass the range by 0.001, which resizing and colour conversion leave, and are clipped.
    """
    tensor = check_floating("image", image, dims=(3,)).detach()
    if tensor.shape[0] not in (1, 3) or tensor.numel() == 0:
        raise ValueError(f"image must have shape (3, H, W) or (1, H, W); got {tuple(tensor.shape)}")
    low, high = float(tensor.min()), float(tensor.max())
    if low < -_TOLERANCE or high > 1 + _TOLERANCE:
        raise ValueError(f"image must lie in [0, 1]; got [{low:g}, {high:g}]")
    pixels = tensor.float().clamp(0, 1).expand(3, -1, -1).permute(1, 2, 0)
    return np.ascontiguousarray(pixels.cpu().numpy())
