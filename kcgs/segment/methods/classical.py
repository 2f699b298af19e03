"""The segmenters of scikit-image, and colours clustered by SciPy: nothing to download, the same map every time."""

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
from kcgs.segment.networks import errors_of, k_means
from kcgs.segment.registry import register

_SUPERPIXELS = Cleanup(snap=2, max_regions=20)


class _Segmenter:
    """A function of ``skimage.segmentation`` with defaults for photos; its superpixels merge by colour."""

    def __init__(self, name: str, view: Callable[[Tensor], NDArray[Any]], **defaults: Any) -> None:
        self.name, self.view, self.defaults = name, view, defaults
        self.__doc__ = f"Segment by scikit-image's function :func:`skimage.segmentation.{name}`, with its parameters."

    @property
    def _function(self) -> Callable[..., Any]:
        import skimage.segmentation

        return functools.partial(getattr(skimage.segmentation, self.name), **self.defaults)

    @property
    def __signature__(self) -> inspect.Signature:
        signature = inspect.signature(self._function)
        most = inspect.Parameter("max_regions", inspect.Parameter.KEYWORD_ONLY, default=None)
        return signature.replace(parameters=[*signature.parameters.values(), most])

    def __call__(self, image: Tensor, *, max_regions: int | None, **options: Any) -> Tensor:
        """Return superpixels, merged to ``max_regions``."""
        defaults = inspect.signature(self._function).parameters
        for name, value in options.items():
            if type(defaults[name].default) is int:
                check_count(name, value, least=0)
            elif type(defaults[name].default) is float:
                check_number(name, value, 0)
        with errors_of(f"{self.name} of scikit-image fails with {options}"):
            regions = connect(np.asarray(self._function(self.view(image), **options), dtype=np.int64))
        if max_regions is not None:
            regions = merge_similar(rgb_to_lab(image), regions, max_regions)
        return torch.from_numpy(regions)


def _to_gray(image: Tensor) -> NDArray[np.float64]:
    return np.asarray(rgb_to_lab(image)[..., 0], dtype=np.float64) / 100


def _edge_strength(image: Tensor) -> NDArray[np.float64]:
    from skimage.filters import sobel

    return np.asarray(sobel(_to_gray(image)), dtype=np.float64)


# Lab over 100 has about the range of RGB in [0, 1], for which the usual scales are known.
register("felzenszwalb")(_Segmenter("felzenszwalb", lambda image: rgb_to_lab(image) / 100, scale=300.0, sigma=1.0))
register("slic", _SUPERPIXELS)(_Segmenter("slic", to_pixels, n_segments=400, sigma=0.0))
register("quickshift", _SUPERPIXELS)(
    _Segmenter("quickshift", to_pixels, kernel_size=3, max_dist=20.0, ratio=0.5, sigma=0.0)
)
register("watershed", _SUPERPIXELS)(_Segmenter("watershed", _edge_strength, markers=400, compactness=0.001))
register("chan_vese")(_Segmenter("chan_vese", _to_gray))


@register("kmeans", _SUPERPIXELS)
def kmeans(image: Tensor, *, num_clusters: int = 6, sigma: float = 1.0, min_size: int) -> NDArray[np.int64]:
    """Cluster the colours by k-means in CIE Lab, take the connected pieces, and merge the most similar neighbours.

    Args:
        image: as `segment` takes it.
        num_clusters: k, at least 1.
        sigma: standard deviation of the smoothing beforehand, in pixels, at least 0.
        min_size: of `Cleanup`.

    Example:
        >>> from kcgs.segment import segment
        >>> image = torch.zeros(3, 20, 30)
        >>> image[0, :, 10:], image[1, :, 20:] = 1.0, 1.0
        >>> segment(image, "kmeans", num_clusters=3, sigma=0.0)[0, ::10].tolist()
        [0, 1, 2]
    """
    from scipy.ndimage import gaussian_filter

    check_number("sigma", sigma, 0)
    lab = gaussian_filter(rgb_to_lab(image).astype(np.float64), (sigma, sigma, 0), mode="nearest")
    return k_means(lab.reshape(-1, 3), num_clusters).reshape(lab.shape[:2])
