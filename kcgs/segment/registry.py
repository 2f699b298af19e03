"""Segmenters by name: an image checked once, the method's own work, one clean-up for all."""

import functools
import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs._repr import brief
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.kernels import threads_for_kernels
from kcgs.segment.cleanup import check_segment_image, connected_regions, merge_similar, merge_small, order_by_area
from kcgs.segment.snapping import snap_contours

# The smallest region as a share of the image: 600 pixels of 481 x 321. Below 250 x 250 pixels, where that is
# less than a line across the image, it is the length of such a line.
_MIN_SHARE = 0.004
# Packages whose line for pip is not the name that is imported.
_PACKAGES = {"skimage": "scikit-image", "PIL": "pillow", "transformers": "'kcgs[segment]'"}


@brief
class Segmentation(NamedTuple):
    """A label map, how sure its method is of every region, and what each is called."""

    labels: Tensor
    """:math:`(H, W)` int64, ids 0 to R - 1 by decreasing area."""
    scores: Tensor | None = None
    """:math:`(R,)` float32 in [0, 1], NaN for a region that the method says nothing about; None: no scores."""
    names: dict[int, str] | None = None
    """By id; several regions may have one name. None: the method knows no names."""


@brief
class Prediction(NamedTuple):
    """What a method says of every pixel, before clean-up; tensors or numpy arrays."""

    labels: Any
    """:math:`(H, W)`, whole numbers of any dtype, also bool, non-negative."""
    scores: Any = None
    """:math:`(H, W)` in [0, 1], NaN where the method says nothing; None: no scores."""
    names: Sequence[str] | None = None
    """What the labels are called, from 0 on; None: the method knows no names."""


# A registered method: an image and options in, a label map out, as `segment` describes them.
Segmenter = Callable[..., Tensor]


@dataclass(frozen=True)
class Cleanup:
    """What is done to the labels of every method, in this order.

    Args:
        snap: contours move by up to so many pixels onto the image's edges (`snap_contours`); 0 leaves them.
        min_size: 4-connected pieces of fewer pixels join a neighbour (`merge_small`), at least 1, which leaves all;
            None: 0.4 % of the image, at least sqrt(H W).
        connected: every 4-connected piece is a region of its own.
        max_regions: the most similar neighbours merge (`merge_similar`) until so many are left; None leaves all.

    Raises:
        TypeError, ValueError: an option has another type or is out of its range.
    """

    snap: int = 0
    min_size: int | None = None
    connected: bool = True
    max_regions: int | None = None

    def __post_init__(self) -> None:
        """Check the options before anything is loaded."""
        check_count("snap", self.snap, least=0)
        for name in ("min_size", "max_regions"):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name))
        if not isinstance(self.connected, bool):
            raise TypeError(f"connected must be True or False; got {self.connected!r}")

    def smallest(self, num_pixels: int) -> int:
        """Return how many pixels the smallest region of an image of so many has."""
        return self.min_size or max(round(_MIN_SHARE * num_pixels), round(math.sqrt(num_pixels)))

    def apply(self, image: Tensor, found: Prediction) -> Segmentation:
        """Clean the labels of an image.

        A region scores the mean of its pixels' scores, and is called as most of its pixels were labelled.
        """
        labels = classes = found.labels.to(image.device)
        if self.snap:
            labels = snap_contours(image, labels, reach=self.snap)
        labels = merge_small(labels, self.smallest(labels.numel()))
        # Pieces of one region become one piece where what lay between them joins it: connect after merging.
        labels = order_by_area(connected_regions(labels) if self.connected else labels)
        if self.max_regions is not None and int(labels.max()) >= self.max_regions:
            labels = order_by_area(merge_similar(image, labels, self.max_regions))
        scores = None if found.scores is None else _region_means(labels, found.scores)
        return Segmentation(labels, scores, None if found.names is None else _names(labels, classes, found.names))


def _region_means(labels: Tensor, scores: Tensor) -> Tensor:
    flat, values = labels.flatten().cpu(), scores.flatten().double().cpu()  # On a GPU sums differ from run to run.
    known = values.isfinite()
    count = int(flat.max()) + 1
    sums = torch.bincount(flat[known], weights=values[known], minlength=count)
    return (sums / torch.bincount(flat[known], minlength=count)).clamp(0, 1).float().to(labels.device)


def _names(labels: Tensor, classes: Tensor, names: Sequence[str]) -> dict[int, str]:
    """Return what every region is called: as the class that most of its pixels have."""
    pairs = (labels * len(names) + classes).flatten()
    counts = pairs.bincount(minlength=(int(labels.max()) + 1) * len(names)).reshape(-1, len(names))
    return {region: names[kind] for region, kind in enumerate(counts.argmax(dim=1).tolist())}


_CLEANUP = tuple(field.name for field in fields(Cleanup))


class _Method:
    """A registered function with its defaults of the clean-up options."""

    def __init__(self, name: str, function: Callable[..., Tensor | Prediction], cleanup: Cleanup) -> None:
        self.name, self.function, self.cleanup = name, function, cleanup
        signature = inspect.signature(function)
        parameters = [parameter for key, parameter in signature.parameters.items() if key not in _CLEANUP]
        keyword = inspect.Parameter.KEYWORD_ONLY
        shared = [inspect.Parameter(key, keyword, default=getattr(cleanup, key)) for key in _CLEANUP]
        self.shared = [key for key in _CLEANUP if key in signature.parameters]
        self.signature = signature.replace(parameters=[*parameters, *shared], return_annotation=Tensor)

    def __call__(self, image: Any, **options: Any) -> Segmentation:
        """Check the image, run the function, and clean what it returns."""
        for option in options:
            if option not in self.signature.parameters:
                known = describe_options(self.name)
                raise InvalidArgumentType("option", f"one of the method {self.name!r}, {known}", repr(option))
        cleanup = replace(self.cleanup, **{key: options.pop(key) for key in _CLEANUP if key in options})
        pixels = check_segment_image(image)
        cleanup = replace(cleanup, min_size=cleanup.smallest(pixels[0].numel()))
        try:
            found = self.function(pixels, **options, **{key: getattr(cleanup, key) for key in self.shared})
        except ImportError as error:
            module = (error.name or "").partition(".")[0]
            if module in ("", "kcgs"):
                raise
            line = f"pip install {_PACKAGES.get(module, module)}"
            raise ImportError(f"segmentation method {self.name!r} needs {module}: {line} ({error})") from error
        with threads_for_kernels(pixels[0].numel()):
            return cleanup.apply(pixels, self._checked(found, tuple(pixels.shape[1:])))

    def _checked(self, found: Any, size: tuple[int, ...]) -> Prediction:
        """Return what the function gave with int64 labels; refuse what says no region for every pixel."""
        found = found if isinstance(found, Prediction) else Prediction(found)
        source = f"from segmentation method {self.name!r} must"
        values = _of_pixels(f"labels {source}", found.labels, size)
        labels = values if values.is_complex() else values.long()
        if values.is_complex() or not torch.equal(labels.to(values.dtype), values):
            raise ValueError(f"labels {source} be whole numbers; got {values.dtype}")
        low, high = int(labels.min()), int(labels.max())
        if low < 0:
            raise ValueError(f"labels {source} be non-negative; got {low}: give pixels of no region an id of their own")
        if found.names is not None and high >= len(found.names):
            raise ValueError(f"names {source} say what label {high} is; got {len(found.names)} names")
        scores = None if found.scores is None else _of_pixels(f"scores {source}", found.scores, size)
        return Prediction(labels, scores, found.names)


def _of_pixels(what: str, values: Any, size: tuple[int, ...]) -> Tensor:
    if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
        values = torch.from_numpy(np.ascontiguousarray(values))
    if not isinstance(values, Tensor):
        kind = f"an array of {values.dtype}" if isinstance(values, np.ndarray) else type(values).__name__
        raise TypeError(f"{what} be a Tensor or a numpy array of numbers; got {kind}")
    if tuple(values.shape) != size:
        raise ValueError(f"{what} have the image's size {size}; got {tuple(values.shape)}")
    return values.detach()


_methods: dict[str, _Method] = {}


def register(name: str, cleanup: Cleanup | None = None) -> Callable[[Callable[..., Tensor | Prediction]], Segmenter]:
    """Make a function a segmentation method.

    The function gets the image as a checked tensor :math:`(3, H, W)` float32 in [0, 1] and its own keyword options. It
    returns labels :math:`(H, W)`, or a `Prediction` with scores and names: whole numbers from 0 on, of any dtype, bool
    and numpy arrays too; what else it returns is refused when it is called. Where it has a parameter with the name of a
    clean-up option, it gets the value that the clean-up will use, ``min_size`` in pixels. It imports optional libraries
    when it runs.

    Args:
        name: a name not in use.
        cleanup: the method's defaults of the clean-up options; None: those of `Cleanup`.

    Returns:
        A decorator. What it returns takes an image and options as `segment` does, clean-up options among them.

    Raises:
        ValueError: the name is empty or taken.

    Example:
        >>> @register("halves")
        ... def halves(image: Tensor) -> Tensor:
        ...     columns = torch.arange(image.shape[-1]) >= image.shape[-1] // 2
        ...     return columns.long().expand(image.shape[-2:])
        >>> segment(torch.zeros(3, 2, 4), method="halves")[0].tolist()
        [0, 0, 1, 1]
        >>> del _methods["halves"]
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"name must be a non-empty string; got {name!r}")
    if name in _methods:
        raise ValueError(f"there is a segmentation method {name!r} already")

    def add(function: Callable[..., Tensor | Prediction]) -> Segmenter:
        method = _methods[name] = _Method(name, function, cleanup or Cleanup())

        @functools.wraps(function)
        def segmenter(image: Any, **options: Any) -> Tensor:
            return method(image, **options).labels

        segmenter.__signature__ = method.signature  # type: ignore[attr-defined]
        return segmenter

    return add


def available_methods() -> list[str]:
    """Return the names that `segment` knows, sorted."""
    return sorted(_methods)


def describe_options(method: str) -> str:
    """Name the options of a method with their defaults, those of clean-up last."""
    _, *options = _methods[method].signature.parameters.values()
    return ", ".join(o.name if o.default is o.empty else f"{o.name}={o.default!r}" for o in options)


def segment(image: Any, method: str = "auto", **options: Any) -> Tensor:
    """Divide an image into regions by the named method.

    Convention: every method takes four options of clean-up, ``snap``, ``min_size``, ``connected`` and ``max_regions``.
    `Cleanup` says what they do; a method's signature says its defaults.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1]; or a numpy array (H, W, C), or a PIL image.
        method: one of `available_methods`.
        options: keyword arguments of that method, and of clean-up.

    Returns:
        :math:`(H, W)` int64 on the device of ``image``. Ids are 0 to R - 1, each in use, by decreasing area; of equal
        areas, the region with the earlier first pixel comes first.

    Raises:
        TypeError: ``image`` is no image, or the method has no such option.
        ValueError: ``method`` is unknown, or ``image`` has another shape, non-finite values or values outside [0, 1].
        ImportError: the method's library is not installed; the message has the line that installs it.

    Example:
        >>> image = torch.zeros(3, 40, 60)
        >>> image[:, :, 20:] = 1.0
        >>> segment(image)[0, ::20].tolist()
        [1, 0, 0]
    """
    return segment_with_scores(image, method, **options).labels


def segment_with_scores(image: Any, method: str = "auto", **options: Any) -> Segmentation:
    """Divide an image into regions as `segment` does; say how sure the method is of each and what it is called.

    Returns:
        The label map that `segment` returns; a score in [0, 1] for every region, the mean over its pixels of what the
        method states as its score; and a name for every region, a prompt or a class. None where a method has none.

    Example:
        >>> image = torch.zeros(3, 40, 60)
        >>> image[:, :, 20:] = 1.0
        >>> labels, scores, names = segment_with_scores(image)
        >>> labels[0, ::20].tolist(), scores, names
        ([1, 0, 0], None, None)
    """
    if method not in _methods:
        raise InvalidArgument("method", f"one of {', '.join(available_methods())}", repr(method))
    return _methods[method](image, **options)
