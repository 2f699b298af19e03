"""Checks of values, which only an operator sees: finite, and where arithmetic in float32 stays finite."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from kcgs._check import check_floating
from kcgs.kernels.whitened import MEAN_LIMIT, SCALE_LIMITS

from .covariance import check_cholesky


def check_values(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    """Refuse what is not finite or out of range; on CUDA without waiting for the answer."""
    if means.numel() == 0:
        return
    if means.device.type != "cpu":
        _assert_values(means, cholesky, colors)
        return
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


def check_id_values(region_ids: Tensor, index: Tensor, least: int, whole: bool) -> None:
    """Refuse negative ids, and warn of Gaussians whose id is not in the map: their `index`, (B, N), is negative.

    `least` is the least index. A map that is not `whole` may have lost regions. On CUDA nothing waits, nothing warns.
    """
    if index.device.type != "cpu":
        torch._assert_async((region_ids >= 0).all(), "region_ids must be non-negative")
    elif least < 0:
        if int(region_ids.min()) < 0:
            raise ValueError(f"region_ids must be non-negative; got {int(region_ids.min())}")
        if whole:
            strangers = region_ids.view_as(index)[index < 0]
            warnings.warn(
                f"{len(strangers)} of {index.numel()} Gaussians paint nothing: regions does not hold their region ids, "
                f"such as {int(strangers[0])}; pass the map that they belong to, or call "
                "field.assign_regions(regions)",
                stacklevel=2,
            )


def _assert_values(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    # written so that NaN fails
    ends = cholesky[..., ::2]
    least, most = SCALE_LIMITS[0] * (1 - 1e-6), SCALE_LIMITS[1]
    torch._assert_async((means.abs() <= MEAN_LIMIT).all(), f"means must be finite, within {MEAN_LIMIT:g} pixels")
    torch._assert_async(
        ((ends >= least) & (ends <= most)).all() & (cholesky[..., 1].abs() <= most).all(),
        f"cholesky must have l11, l22 in [{SCALE_LIMITS[0]:g}, {most:g}] pixels and |l21| at most {most:g}",
    )
    torch._assert_async(torch.isfinite(colors).all(), "colors must be finite")
