"""Checks of values, which only an operator sees: finite, and in the range where float32 stays finite."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument
from kcgs.kernels.whitened import MEAN_LIMIT, SCALE_LIMITS

_OUT_OF_RANGE = (
    "Where an optimizer's step made them so, take a smaller learning rate, or kcgs.optim.GaussianAdam, which keeps a "
    "field valid; kcgs.functional.activate_gaussians makes a network's output valid"
)
_NOT_FINITE = "A loss or a gradient that is not finite, or a learning rate that is far too large, makes parameters so"


def check_values(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    """Refuse values that are not finite or out of range; on CUDA by assertions, without device synchronisation."""
    if means.numel() == 0:
        return
    if means.device.type != "cpu":
        _assert_values(means, cholesky, colors)
        return
    # the extremes of a tensor with NaN are NaN: one pass checks finiteness and range; comparisons with NaN must fail
    low, high = (float(t) for t in torch.aminmax(means))
    if not (low >= -MEAN_LIMIT and high <= MEAN_LIMIT):
        raise _invalid("means", f"finite, within {MEAN_LIMIT:g} pixels", means, f"[{low:g}, {high:g}]")
    smallest, largest = (float(t) for t in torch.aminmax(cholesky[..., ::2]))
    low, high = (float(t) for t in torch.aminmax(cholesky[..., 1]))
    least, most = SCALE_LIMITS
    if not (smallest >= least * (1 - 1e-6) and max(largest, -low, high) <= most):
        bounds = f"finite, l11 and l22 in [{least:g}, {most:g}] pixels and |l21| at most {most:g}"
        extremes = f"l11 and l22 in [{smallest:g}, {largest:g}], l21 in [{low:g}, {high:g}]"
        raise _invalid("cholesky", bounds, cholesky, extremes)
    low, high = (float(t) for t in torch.aminmax(colors))
    if not (low > -math.inf and high < math.inf):
        raise _invalid("colors", "finite", colors, f"[{low:g}, {high:g}]")


def _invalid(name: str, expected: str, tensor: Tensor, extremes: str) -> InvalidArgument:
    """Return the error of values that are not finite, or of their extremes."""
    count = int((~tensor.isfinite()).sum())
    received = f"{count} NaN or infinite values. {_NOT_FINITE}" if count else f"{extremes}. {_OUT_OF_RANGE}"
    return InvalidArgument(name, expected, received)


def check_region_ids(region_ids: Tensor, index: Tensor, complete: bool) -> None:
    """Refuse negative ids, and warn of Gaussians whose id is not in the map: their `index`, (B, N), is negative.

    No warning where a map that is not `complete` may have lost regions, and on CUDA: no device synchronisation.
    """
    if index.device.type != "cpu":
        torch._assert_async((region_ids >= 0).all(), "region_ids must be non-negative")
        return
    if int(region_ids.min()) < 0:
        raise ValueError(f"region_ids must be non-negative; got {int(region_ids.min())}")
    foreign = region_ids.view_as(index)[index < 0]
    if complete and len(foreign):
        warn_user(
            f"{len(foreign)} of {index.numel()} Gaussians paint nothing: regions does not hold their region ids, such "
            f"as {int(foreign[0])}; pass the map that they belong to, or call field.assign_regions(regions)"
        )


def _assert_values(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    # comparisons with NaN must fail
    diagonal = cholesky[..., ::2]
    least, most = SCALE_LIMITS[0] * (1 - 1e-6), SCALE_LIMITS[1]
    torch._assert_async((means.abs() <= MEAN_LIMIT).all(), f"means must be finite, within {MEAN_LIMIT:g} pixels")
    torch._assert_async(
        ((diagonal >= least) & (diagonal <= most)).all() & (cholesky[..., 1].abs() <= most).all(),
        f"cholesky must have l11, l22 in [{SCALE_LIMITS[0]:g}, {most:g}] pixels and |l21| at most {most:g}",
    )
    torch._assert_async(torch.isfinite(colors).all(), "colors must be finite")
