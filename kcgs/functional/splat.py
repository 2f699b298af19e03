"""The one public way to render Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs._check import check_cutoff, check_floating, check_ids, check_rows, check_size
from kcgs._torch_internals import register_decomposition
from kcgs.errors import InvalidArgument
from kcgs.kernels import check_backend
from kcgs.maps import MapTable, RegionMap, table_and_size

from .arguments import SplatArguments
from .decomposition import decompose
from .operator import splat_operator

# for torch.onnx.export alone: compilers and torch.export keep the operator
register_decomposition(splat_operator, decompose)


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
    not clamped. It is differentiable in means, cholesky and colors: once, by backward; with backend "reference" twice,
    of which one may be forward. It is the operator ``torch.ops.kcgs.region_splat``: one node in graphs of
    `torch.compile` and `torch.export`. `torch.func` transforms it; `vmap` makes the batch larger.

    Args:
        means: centres in pixels, within 1e8, :math:`(B, N, 2)`; for one image, all tensors may come without B.
        cholesky: factors (l11, l21, l22) of the covariances in pixels, l11 and l22 in [1e-6, 1e8],
            :math:`(B, N, 3)`.
        colors: any range, opacity merged, :math:`(B, N, C)`, C at least 1.
        region_ids: integer region of each Gaussian, :math:`(B, N)`; needed where `regions` is given, and None without.
        regions: a RegionMap, or labels, :math:`(H, W)` or :math:`(B, H, W)`, whose contours are hard; None: one region.
        size: (height, width); needed without `regions`, else it must equal the size of `regions`.
        cutoff: weights below it are skipped, in [0, 1), and backend cpu interpolates wide Gaussians between coarse
            nodes. A skipped Gaussian is off by at most cutoff times its absolute colour, an interpolated one by 3.2
            times that, see docs/performance.md. 0 evaluates all Gaussians at all pixels.
        backend: auto, reference, tiled, cpu or cuda.

    Returns:
        Image, :math:`(B, C, H, W)`, or :math:`(C, H, W)` for unbatched input, in the dtype of `colors`.

    Raises:
        TypeError: an argument of the wrong type or dtype.
        ValueError: shapes that do not fit, devices that differ, values that are not finite or out of range.

    Warns:
        UserWarning: Gaussians whose region ids the map does not hold.

    Example:
        >>> means, cholesky = torch.tensor([[2.5, 0.5]]), torch.tensor([[1.0, 0.0, 1.0]])
        >>> labels = torch.tensor([[0, 0, 0, 1, 1]])
        >>> region_splat(means, cholesky, torch.ones(1, 1), torch.tensor([0]), labels).round(decimals=3)
        tensor([[[0.1350, 0.6070, 1.0000, 0.0000, 0.0000]]])

    Source: the paper's region-constrained sum (its third equation), with memberships s in place of [M = r].
    """
    if size is not None:
        size = check_size("size", size)
    if regions is None:
        if region_ids is not None:
            raise InvalidArgument(
                "regions",
                "given with region_ids",
                "None: pass the label map, or leave region_ids out, too, to render Gaussians that are not confined",
            )
        if size is None:
            raise InvalidArgument("size", "given as (height, width) where regions is None", "None")
        return splat_at(size, means, cholesky, colors, cutoff=cutoff, backend=backend)
    table, map_size = table_and_size(regions)
    if size not in (None, map_size):
        raise ValueError(f"size must equal the size of regions, {map_size}; got {size}")
    return splat_at(map_size, means, cholesky, colors, region_ids, table, cutoff=cutoff, backend=backend)


def splat_at(
    size: tuple[int, int],
    means: Tensor,
    cholesky: Tensor,
    colors: Tensor,
    region_ids: Tensor | None = None,
    table: MapTable | None = None,
    *,
    cutoff: float,
    backend: str,
) -> Tensor:
    """Render at a size; the map is sampled as by :meth:`RegionMap.resize`; ids and map come together."""
    _check_gaussians(means, cholesky, colors)
    if table is not None:
        region_ids = check_ids("region_ids", region_ids, means, values=False)
        _check_map(table, means)
    dtype = torch.float64 if torch.float64 in (means.dtype, cholesky.dtype, colors.dtype) else torch.float32
    means, cholesky, converted = (t if t.dtype == dtype else t.to(dtype) for t in (means, cholesky, colors))
    backend = check_backend(backend)
    arguments = SplatArguments(means, cholesky, converted, region_ids, table, size, check_cutoff(cutoff), backend)
    image: Tensor = splat_operator(*arguments.flatten())
    return image if colors.dtype == dtype else image.to(colors.dtype)


def _check_gaussians(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    check_floating("means", means, last=2, dims=(2, 3), finite=False)
    check_floating("cholesky", cholesky, last=3, finite=False)
    check_floating("colors", colors, dims=(2, 3), finite=False)
    check_rows("cholesky", cholesky, means, 3)
    check_rows("colors", colors, means, "C")
    for name, tensor in (("cholesky", cholesky), ("colors", colors)):
        if tensor.device != means.device:
            raise InvalidArgument(name, f"on {means.device} with means", tensor.device)
    if means.ndim == 3 and means.shape[0] == 0:
        raise InvalidArgument("means", "at least one image", f"shape {tuple(means.shape)}", verb="hold")


def _check_map(table: MapTable, means: Tensor) -> None:
    if table.labels.device != means.device:
        raise InvalidArgument("regions", f"on {means.device} with means", table.labels.device)
    maps = table.shape[0]
    images = means.shape[0] if means.ndim == 3 else 1
    if maps not in (1, images):
        raise InvalidArgument("regions", f"1 map or one for each of {images} images", f"{maps} maps", verb="hold")
