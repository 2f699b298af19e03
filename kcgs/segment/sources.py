"""What the learned and the file sources share: scores, clean-up, libraries imported when used."""

import functools
import importlib
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, ParamSpec, TypedDict, Unpack

import torch
import torch.nn.functional as F
from torch import Tensor

from kcgs.segment.base import available_methods, names_missing_library, register, segment
from kcgs.segment.classical import smallest_size
from kcgs.segment.cleanup import absorb_specks, check_count, connected_regions, merge_similar, order_by_area
from kcgs.segment.contours import snap_contours
from kcgs.segment.names import region_names

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_LONGEST = 240  # Of an error's line: libraries list every weight.


class Segmentation(NamedTuple):
    """A label map, how sure its source is of every region, and what each is called."""

    labels: Tensor
    """:math:`(H, W)` int64, ids 0 to R - 1 by decreasing area."""
    scores: Tensor | None
    """:math:`(R,)` float32 in [0, 1], NaN for a region that the source says nothing about; None: no scores."""
    names: dict[int, str] | None = None
    """By id; several regions may have one name. None: the source knows no names."""


class CleanupOptions(TypedDict, total=False):
    """Keyword options that every learned and file source takes beside its own; see `Cleanup`."""

    min_size: int | None
    snap: int
    max_regions: int | None
    connected: bool


@dataclass(frozen=True)
class Cleanup:
    """What is done to a source's labels, in this order.

    Args:
        snap: contours move by up to so many pixels onto the image's edges (`snap_contours`); 0 leaves them.
        min_size: pieces of fewer pixels are absorbed, at least 1, which leaves all; None: 0.4 % of the image,
            at least sqrt(H W).
        connected: every 4-connected piece is a region of its own.
        max_regions: the most similar neighbours merge until so many are left; None leaves all.

    Raises:
        TypeError: an option has another type.
        ValueError: a number is out of its range.
    """

    min_size: int | None = None
    snap: int = 0
    max_regions: int | None = None
    connected: bool = True

    def __post_init__(self) -> None:
        """Check the options before anything is loaded."""
        if self.min_size is not None:
            check_count("min_size", self.min_size)
        if self.max_regions is not None:
            check_count("max_regions", self.max_regions)
        if isinstance(self.snap, bool) or not isinstance(self.snap, int):
            raise TypeError(f"snap must be an integer; got {self.snap!r}")
        if self.snap < 0:
            raise ValueError(f"snap must be at least 0; got {self.snap}")
        if not isinstance(self.connected, bool):
            raise TypeError(f"connected must be True or False; got {self.connected!r}")

    def apply(
        self, image: Tensor, labels: Tensor, scores: Tensor | None = None, names: Sequence[str] | None = None
    ) -> Segmentation:
        """Clean the labels (H, W) of an image.

        A region scores the mean of its pixels' scores (H, W). With ``names``, one a label from 0 on, it is called as
        most of its pixels were labelled.
        """
        labels = labels.to(image.device)
        classes = labels
        if self.snap:
            labels = snap_contours(image, labels, reach=self.snap)
        labels = absorb_specks(labels, smallest_size(labels.numel(), self.min_size))
        if self.connected:
            labels = connected_regions(labels)
        if self.max_regions is not None:
            labels = merge_similar(image, labels, self.max_regions)
        labels = order_by_area(labels)
        return Segmentation(
            labels,
            None if scores is None else _region_means(labels, scores),
            None if names is None else region_names(labels, classes, names),
        )


_P = ParamSpec("_P")
_scored: dict[str, Callable[..., Segmentation]] = {}


def register_scored(name: str) -> Callable[[Callable[_P, Segmentation]], Callable[_P, Tensor]]:
    """Make a segmenter that also scores its regions available by a name.

    Args:
        name: a name not in use.

    Returns:
        A decorator that returns the segmenter without its scores, as `segment` calls it; `segment_with_scores`
        calls the segmenter itself.

    Raises:
        ValueError: the name is empty or taken.

    Example:
        >>> from kcgs.segment.base import _methods
        >>> @register_scored("one")
        ... def one(image: Tensor) -> Segmentation:
        ...     return Segmentation(torch.zeros(image.shape[-2:], dtype=torch.int64), torch.ones(1))
        >>> one(torch.zeros(3, 1, 2)).tolist(), segment_with_scores(torch.zeros(3, 1, 2), "one").scores.tolist()
        ([[0, 0]], [1.0])
        >>> del _methods["one"], _scored["one"]
    """

    def add(function: Callable[_P, Segmentation]) -> Callable[_P, Tensor]:
        @functools.wraps(function)
        def labels_only(*args: _P.args, **kwargs: _P.kwargs) -> Tensor:
            return function(*args, **kwargs).labels

        signature = inspect.signature(function).replace(return_annotation=Tensor)
        labels_only.__signature__ = signature  # type: ignore[attr-defined]
        register(name)(labels_only)
        _scored[name] = function
        return labels_only

    return add


def segment_with_scores(image: Tensor, method: str = "auto", **options: object) -> Segmentation:
    """Divide an image into regions by the named method; say how sure it is of each and what it is called.

    Args:
        image: :math:`(3, H, W)` or :math:`(1, H, W)` floating in [0, 1].
        method: one of `available_methods`.
        options: keyword arguments of that method.

    Returns:
        The label map that `segment` returns; a score in [0, 1] for every region, the mean over its pixels of what the
        method states as its score; and a name for every region, a prompt or a class. None where a method has none.

    Raises:
        TypeError: ``image`` is no floating tensor, or the method has no such option.
        ValueError: ``method`` is unknown, or ``image`` has another shape, non-finite values or values outside
            [0, 1].
        ImportError: the method's library is not installed.

    Example:
        >>> image = torch.zeros(3, 40, 60)
        >>> image[:, :, 20:] = 1.0
        >>> labels, scores, names = segment_with_scores(image)
        >>> labels[0, ::20].tolist(), scores, names
        ([1, 0, 0], None, None)
    """
    if method in _scored and method in available_methods():
        with names_missing_library(method):
            return _scored[method](image, **options)
    return Segmentation(segment(image, method, **options), None)


def cleanup_of(options: CleanupOptions, **defaults: Unpack[CleanupOptions]) -> Cleanup:
    """Return the clean-up of a call, its own options over a method's defaults."""
    merged: dict[str, Any] = {**defaults, **options}
    known = [field.name for field in fields(Cleanup)]
    unknown = [name for name in merged if name not in known]
    if unknown:
        raise TypeError(f"the method has no option {unknown[0]!r}; clean-up takes {', '.join(known)}")
    return Cleanup(**merged)


def require(module: str, package: str, used_by: str) -> ModuleType:
    """Import a library when a method uses it.

    Raises:
        ImportError: it is not installed; the message has the line that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"segmentation method {used_by!r} needs {module.split('.')[0]}: pip install {package} ({error})"
        ) from error


def load_pretrained(class_name: str, model: Any, used_by: str, device: torch.device) -> Any:
    """Return a model of transformers in evaluation mode, from a folder, a hub id, or loaded already.

    Raises:
        FileNotFoundError: ``model`` can only be a folder, and there is none.
        ImportError: transformers is not installed.
        ValueError: it cannot be loaded, or the folder's weights do not fill the model.
    """
    transformers = require("transformers", "'kcgs[segment]'", used_by)
    if isinstance(model, torch.nn.Module):
        return model.eval().to(device)
    model = str(Path(model).expanduser()) if str(model).startswith("~") else str(model)
    if (Path(model).is_absolute() or model.startswith(".") or model.count("/") > 1) and not Path(model).is_dir():
        raise FileNotFoundError(f"no folder with a model for {used_by!r} at {model}")
    log = transformers.utils.logging
    level, bar = log.get_verbosity(), log.is_progress_bar_enabled()
    log.set_verbosity_error()
    log.disable_progress_bar()
    try:
        loaded, info = getattr(transformers, class_name).from_pretrained(model, output_loading_info=True)
    except Exception as error:  # Whatever a damaged file, a wrong config or a missing network raises.
        raise ValueError(f"cannot load {model!r} as {class_name} for {used_by!r}: {first_line(error)}") from error
    finally:
        log.set_verbosity(level)
        if bar:
            log.enable_progress_bar()
    # Pooling heads are no part of many published checkpoints, and nothing here reads them.
    missing = sorted(key for key in info["missing_keys"] if "pooler" not in key)
    if missing:
        raise ValueError(
            f"cannot load {model!r} as {class_name} for {used_by!r}: it lacks {len(missing)} weights, "
            f"{missing[0]} among them"
        )
    return loaded.eval().to(device)


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, with what it announces, not too long; or the error's kind."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    if not lines:
        return type(error).__name__
    text = " ".join(lines[:2]) if lines[0].endswith(":") else lines[0]
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def check_share(name: str, value: float) -> float:
    """Return a number in [0, 1]."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} must be a number in [0, 1]; got {value!r}")
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name} must be in [0, 1]; got {value!r}")
    return float(value)


def normalized(image: Tensor, mean: tuple[float, ...], std: tuple[float, ...]) -> Tensor:
    """Return (B, 3, H, W) less ``mean``, over ``std``."""
    return (image - image.new_tensor(mean)[:, None, None]) / image.new_tensor(std)[:, None, None]


def largest_map(maps: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Enlarge maps one at a time, so that many classes of a large picture fit, and find the largest.

    Args:
        maps: :math:`(1, C, h, w)`.
        size: (height, width).

    Returns:
        Its index, its value and its softmax, each of ``size``.
    """
    best = torch.full(size, -torch.inf, device=maps.device)
    total, index = best.clone(), torch.zeros(size, dtype=torch.int64, device=maps.device)
    for k in range(maps.shape[1]):
        one = F.interpolate(maps[:, k : k + 1].float(), size, mode="bilinear", align_corners=False)[0, 0]
        index[one > best] = k
        best = torch.maximum(best, one)
        total = torch.logaddexp(total, one)
    return index, best, (best - total).exp()


def _region_means(labels: Tensor, scores: Tensor) -> Tensor:
    flat, values = labels.flatten().cpu(), scores.flatten().double().cpu()  # On a GPU sums differ from run to run.
    known = values.isfinite()
    count = int(flat.max()) + 1
    sums = torch.bincount(flat[known], weights=values[known], minlength=count)
    return (sums / torch.bincount(flat[known], minlength=count)).clamp(0, 1).float().to(labels.device)
