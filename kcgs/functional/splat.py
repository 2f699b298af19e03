"""The one public way to render Gaussians."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs._check import check_cutoff, check_floating, check_ids, check_rows, check_size, check_tensor
from kcgs.kernels import Membership, SplatInputs, resolve

from .covariance import check_cholesky
from .regions import RegionMap

# float32 arithmetic stays finite inside these bounds, which are far beyond any image
MEAN_LIMIT = 1e8
SCALE_LIMITS = (1e-6, 1e8)


def region_splat(
    means: Tensor,
    cholesky: Tensor,
    colors: Tensor,
    region_ids: Tensor | None = None,
    regions: RegionMap | Tensor | None = None,
    *,
    size: tuple[int, int] | None = None,
    cutoff: float = 1e-4,
    backend: str = "auto",
) -> Tensor:
    r"""Render an image as a sum of anisotropic Gaussians, each confined to its region of a label map.

    .. math:: I(p) = \sum_i s_{r_i}(p) \exp\left(-\tfrac12 (p - \mu_i)^T \Sigma_i^{-1} (p - \mu_i)\right) c_i

    Convention: points are (x, y) in pixels and pixel (j, i) is sampled at (j + 0.5, i + 0.5); a Gaussian whose id the
    map does not hold paints nothing; N = 0 gives a black image. Half precision is computed in float32. The result is
    not clamped. Once differentiable in means, cholesky and colors, by `backward` and `torch.autograd.grad`;
    `torch.func.grad`, `vjp` and `jvp` work with backend "reference" only, and `vmap` is refused: give the batch as B.

    Args:
        means: centres in pixels, within 1e8, :math:`(B, N, 2)`, or all without B.
        cholesky: factors (l11, l21, l22) of the covariances in pixels, l11 and l22 in [1e-6, 1e8],
            :math:`(B, N, 3)`.
        colors: any range, opacity merged, :math:`(B, N, C)`, C at least 1.
        region_ids: integer region of each Gaussian, :math:`(B, N)`; needed where `regions` is given, and None without.
        regions: label map (a Tensor means hard contours) for all images or :math:`(B, H, W)`; None: one region.
        size: (height, width); needed without `regions`, else it must equal theirs.
        cutoff: weights below it are skipped, in [0, 1); 0 evaluates all. The image is off by at most cutoff times the
            sum of the absolute colours that overlap there.
        backend: auto, reference, tiled, cpu or cuda.

    Returns:
        Image, :math:`(B, C, H, W)`, or :math:`(C, H, W)` for unbatched input, in the dtype of `colors`.

    Raises:
        TypeError: an argument of the wrong type or dtype.
        ValueError: shapes that do not fit, devices that differ, values that are not finite or out of range.

    Example:
        >>> means, cholesky = torch.tensor([[2.5, 0.5]]), torch.tensor([[1.0, 0.0, 1.0]])
        >>> labels = torch.tensor([[0, 0, 0, 1, 1]])
        >>> region_splat(means, cholesky, torch.ones(1, 1), torch.tensor([0]), labels).round(decimals=3)
        tensor([[[0.1350, 0.6070, 1.0000, 0.0000, 0.0000]]])

    Source: the paper's region-constrained sum (its third equation), with memberships s in place of [M = r].
    """
    _check_gaussians(means, cholesky, colors)
    batched = means.ndim == 3
    dtype = torch.float64 if torch.float64 in (means.dtype, cholesky.dtype, colors.dtype) else torch.float32
    arrays = [t.to(dtype) if batched else t.to(dtype)[None] for t in (means, cholesky, colors)]
    cutoff = check_cutoff(cutoff)
    index, membership, size = _resolve_regions(means, region_ids, regions, size)
    kernel = resolve(backend, means.device, dtype)
    image = kernel(SplatInputs(arrays[0], arrays[1], arrays[2], index, membership, size, cutoff))
    return (image if batched else image.squeeze(0)).to(colors.dtype)


def _check_gaussians(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    check_floating("means", means, last=2, dims=(2, 3), finite=False)
    check_floating("cholesky", cholesky, last=3, finite=False)
    check_floating("colors", colors, dims=(2, 3), finite=False)
    for name, tensor, last in (("cholesky", cholesky, 3), ("colors", colors, "C")):
        check_rows(name, tensor, means, last)
        if tensor.device != means.device:
            raise ValueError(f"{name} must be on {means.device} with means; got {tensor.device}")
    if means.shape[0] == 0 and means.ndim == 3:
        raise ValueError(f"means must hold at least one image; got shape {tuple(means.shape)}")
    if means.numel():
        _check_values(means.detach(), cholesky.detach(), colors.detach())


def _check_values(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    # extremes carry NaN along, so that one pass checks finiteness and range; written so that NaN fails
    low, high = (float(t) for t in torch.aminmax(means))
    if not (low >= -MEAN_LIMIT and high <= MEAN_LIMIT):
        check_floating("means", means)
        raise ValueError(f"means must be within {MEAN_LIMIT:g} pixels; got {max(-low, high):g}")
    least, most = (float(t) for t in torch.aminmax(cholesky[..., ::2]))
    low, high = (float(t) for t in torch.aminmax(cholesky[..., 1]))
    if not (least >= SCALE_LIMITS[0] * (1 - 1e-6) and max(most, -low, high) <= SCALE_LIMITS[1]):
        check_cholesky("cholesky", cholesky)
        raise ValueError(
            f"cholesky must have l11, l22 in [{SCALE_LIMITS[0]:g}, {SCALE_LIMITS[1]:g}] pixels and |l21| at most "
            f"{SCALE_LIMITS[1]:g}; got a least diagonal of {least:g} and a largest value of {max(most, -low, high):g}"
        )
    low, high = (float(t) for t in torch.aminmax(colors))
    if not (low > -math.inf and high < math.inf):
        check_floating("colors", colors)


def _resolve_regions(
    means: Tensor, region_ids: Tensor | None, regions: RegionMap | Tensor | None, size: tuple[int, int] | None
) -> tuple[Tensor | None, Membership | None, tuple[int, int]]:
    if size is not None:
        size = check_size("size", size)
    if region_ids is not None:
        region_ids = check_ids("region_ids", region_ids, means)
    regions = RegionMap.coerce(regions)
    if regions is None:
        if region_ids is not None:
            raise ValueError(
                "regions must be given with region_ids; got None: pass the label map, or leave region_ids out, too, to "
                "render Gaussians that are not confined"
            )
        if size is None:
            raise ValueError("size must be given as (height, width) where regions is None; got None")
        return None, None, size
    check_tensor("region_ids", region_ids)
    assert region_ids is not None
    _check_fit(means, regions, size)
    index = regions.index_of(region_ids)
    if index.ndim == 1:
        index = index[None]
    if regions.num_regions == 1:
        # one region covers everything: no map, but Gaussians of other ids still paint nothing
        return (None, None, regions.size) if bool((index >= 0).all()) else (index, regions.membership, regions.size)
    return index, regions.membership, regions.size


def _check_fit(means: Tensor, regions: RegionMap, size: tuple[int, int] | None) -> None:
    if size is not None and size != regions.size:
        raise ValueError(f"size must equal the size of regions, {regions.size}; got {size}")
    if regions.labels.device != means.device:
        raise ValueError(f"regions must be on {means.device} with means; got {regions.labels.device}")
    maps = regions.labels.shape[0] if regions.labels.ndim == 3 else 1
    images = means.shape[0] if means.ndim == 3 else 1
    if maps not in (1, images):
        raise ValueError(f"regions must hold 1 map or one for each of {images} images; got {maps} maps")
