"""Segmenters by name: each call checks the image, runs the method's function, and cleans up its labels."""

import inspect
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from kcgs.errors import InvalidArgument, InvalidArgumentType

from .cleanup import Cleanup, Segmentation
from .images import check_segment_image

Function = TypeVar("Function", bound=Callable[..., Any])


class _Method(NamedTuple):
    function: Callable[..., Any]
    cleanup: Cleanup
    takes_cleanup: bool


_methods: dict[str, _Method] = {}


def segment(image: Any, method: str = "auto", **options: Any) -> Tensor:
    """Divide an image into regions by the named method.

    Convention: every method has the four options of `Cleanup`, ``snap``, ``min_size``, ``connected`` and
    ``max_regions``; `method_options` returns its defaults.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)`, as :func:`kcgs.fit` takes it; or a batch of them.
        method: one of `available_methods`.
        options: of the method and of `Cleanup`.

    Returns:
        :math:`(H, W)` int64 on the device of ``image``, or :math:`(B, H, W)` for a batch. Ids are 0 to R - 1, each in
        use, by decreasing area; of equal areas, the region with the earlier first pixel comes first.

    Raises:
        TypeError: ``image`` is no image, or the method has no such option.
        ValueError: ``method`` is unknown, or ``image`` has another shape, non-finite values or values outside [0, 1].
        ImportError: the method's library is not installed; the message has the line that installs it.

    Example:
        >>> import torch
        >>> image = torch.zeros(3, 40, 60)
        >>> image[:, :, 20:] = 1.0
        >>> segment(image)[0, ::20].tolist()
        [1, 0, 0]
    """
    if isinstance(image, Tensor) and image.ndim == 4 and len(image):
        return torch.stack([segment(one, method, **options) for one in image])
    return segment_with_scores(image, method, **options).labels


def segment_with_scores(image: Any, method: str = "auto", **options: Any) -> Segmentation:
    """Divide an image into regions as `segment` does, and return their scores and names too.

    Returns:
        The label map of `segment`; a score in [0, 1] for every region, the mean over its pixels; and a name for every
        region, a prompt or a class. Scores or names are None if the method has none.

    Example:
        >>> import torch
        >>> image = torch.zeros(3, 40, 60)
        >>> image[:, :, 20:] = 1.0
        >>> labels, scores, names = segment_with_scores(image)
        >>> labels[0, ::20].tolist(), scores, names
        ([1, 0, 0], None, None)
    """
    defaults = method_options(method)
    for option in options:
        if option not in defaults:
            raise InvalidArgumentType("option", f"one of the method {method!r}, {', '.join(defaults)}", repr(option))
    for option, default in defaults.items():
        if default is inspect.Parameter.empty and option not in options:
            raise InvalidArgumentType(option, f"given for the method {method!r}", "none")
    function, cleanup, takes_cleanup = _methods[method]
    cleanup = replace(cleanup, **{name: options.pop(name) for name in asdict(cleanup) if name in options})
    pixels = check_segment_image(image)
    if takes_cleanup:
        options["cleanup"] = cleanup
    return cleanup.apply(pixels, function(pixels, **options))


def available_methods() -> list[str]:
    """Return the names that `segment` knows, sorted."""
    return sorted(_methods)


def method_options(method: str) -> dict[str, Any]:
    """Return the options of a method with their defaults, clean-up last; ``Parameter.empty``: no default.

    Raises:
        ValueError: no such method.

    Example:
        >>> method_options("auto")
        {'objects': None, 'snap': 0, 'min_size': None, 'connected': True, 'max_regions': 30}
    """
    if method not in _methods:
        raise InvalidArgument("method", f"one of {', '.join(available_methods())}", repr(method))
    function, cleanup, _ = _methods[method]
    _, *parameters = inspect.signature(function).parameters.values()
    own = {option.name: option.default for option in parameters if option.name != "cleanup"}
    shared = asdict(cleanup)
    if names := own.keys() & shared.keys():  # not when it is registered: a signature may load a library
        raise InvalidArgument("function", "without options of the clean-up: see takes_cleanup", sorted(names))
    return own | shared


def register(
    name: str, cleanup: Cleanup | None = None, *, takes_cleanup: bool = False
) -> Callable[[Function], Function]:
    """Make a function a segmentation method.

    The function gets the image, a checked tensor :math:`(3, H, W)` float32 in [0, 1], and the options of its keyword
    parameters. It returns labels :math:`(H, W)`, integer or bool, a tensor or a numpy array; or a `Prediction` with
    scores and names. Optional libraries are imported inside the function.

    Args:
        name: a new name for `segment`. The same function, defined once more in a notebook, replaces itself.
        cleanup: the method's defaults of the clean-up options; None: those of `Cleanup`.
        takes_cleanup: whether the function also gets the `Cleanup` of its labels, as the keyword ``cleanup``.

    Returns:
        A decorator that returns the function.

    Raises:
        ValueError: the name is empty or that of another function. When the method is used: the function has a parameter
            with the name of a clean-up option.

    Example:
        >>> import torch
        >>> @register("halves")
        ... def halves(image: Tensor) -> Tensor:
        ...     columns = torch.arange(image.shape[-1]) >= image.shape[-1] // 2
        ...     return columns.expand(image.shape[-2:])
        >>> segment(torch.zeros(3, 2, 4), method="halves")[0].tolist()
        [0, 0, 1, 1]
    """

    def add(function: Function) -> Function:
        method = _Method(function, cleanup or Cleanup(), takes_cleanup)
        if not name or _place(_methods.get(name, method).function) != _place(function):
            expected = f"a new name, not empty, none of {', '.join(available_methods())}"
            raise InvalidArgument("name", expected, repr(name))
        _methods[name] = method
        return function

    return add


def _place(function: Callable[..., Any]) -> tuple[str, str]:
    """Return where a function is defined: its module and its name there."""
    return function.__module__, getattr(function, "__qualname__", "")
