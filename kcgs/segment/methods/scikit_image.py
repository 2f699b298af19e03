"""The segmenters of scikit-image: deterministic, without downloads."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs._check import check_count, check_number
from kcgs.segment.cleanup import Cleanup, connect, merge_similar
from kcgs.segment.images import rgb_to_lab, to_pixels
from kcgs.segment.networks import library_errors
from kcgs.segment.registry import register

_SUPERPIXELS = Cleanup(snap=2, max_regions=20)


class _Segmenter:
    """A function of ``skimage.segmentation`` with defaults for photos; its signature is read on use."""

    def __init__(self, name: str, convert: Callable[[Tensor], NDArray[Any]], **defaults: Any) -> None:
        self.name = name
        self.convert = convert
        self.defaults = defaults
        self.__doc__ = f"Segment by scikit-image's function :func:`skimage.segmentation.{name}`, with its parameters."

    @property
    def _function(self) -> Callable[..., Any]:
        import skimage.segmentation

        return functools.partial(getattr(skimage.segmentation, self.name), **self.defaults)

    @property
    def __signature__(self) -> inspect.Signature:
        signature = inspect.signature(self._function)
        # felzenszwalb has an option of the clean-up
        return signature.replace(parameters=[p for p in signature.parameters.values() if p.name != "min_size"])

    def __call__(self, image: Tensor, *, cleanup: Cleanup, **options: Any) -> Tensor:
        """Return the segments, after the most similar neighbours have merged to ``max_regions`` of the clean-up."""
        defaults = inspect.signature(self._function).parameters
        for name, value in options.items():
            if type(defaults[name].default) is int:
                check_count(name, value, least=0)
            elif type(defaults[name].default) is float:
                check_number(name, value, 0)
        if "min_size" in defaults:
            options["min_size"] = cleanup.min_pixels(image[0].numel())
        with library_errors(f"{self.name} of scikit-image fails with {options}"):
            regions = connect(np.asarray(self._function(self.convert(image), **options), dtype=np.int64))
        return torch.from_numpy(merge_similar(image, regions, cleanup.max_regions))


def _to_lightness(image: Tensor) -> NDArray[np.float64]:
    return np.asarray(rgb_to_lab(image)[..., 0], dtype=np.float64) / 100


def _edge_strength(image: Tensor) -> NDArray[np.float64]:
    from skimage.filters import sobel

    return np.asarray(sobel(_to_lightness(image)), dtype=np.float64)


def _add(name: str, convert: Callable[[Tensor], NDArray[Any]], cleanup: Cleanup | None = None, **defaults: Any) -> None:
    register(name, cleanup, takes_cleanup=True)(_Segmenter(name, convert, **defaults))


# Lab over 100 has about the range of RGB in [0, 1], for which the usual scales are known.
_add("felzenszwalb", lambda image: rgb_to_lab(image) / 100, scale=300.0, sigma=1.0)
_add("slic", to_pixels, _SUPERPIXELS, n_segments=400, sigma=0.0)
_add("quickshift", to_pixels, _SUPERPIXELS, kernel_size=3, max_dist=20.0, ratio=0.5, sigma=0.0)
_add("watershed", _edge_strength, _SUPERPIXELS, markers=400, compactness=0.001)
_add("chan_vese", _to_lightness)
