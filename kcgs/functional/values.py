"""Checks of values, which only an operator sees: finite, and where arithmetic in float32 stays finite."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs._check import check_floating

from .covariance import check_cholesky

# float32 arithmetic stays finite inside these bounds, which are far beyond any image
MEAN_LIMIT = 1e8
SCALE_LIMITS = (1e-6, 1e8)


def check_values(means: Tensor, cholesky: Tensor, colors: Tensor, region_ids: Tensor | None) -> None:
    """Refuse what is not finite or out of range, and negative ids; on CUDA without waiting for the answer."""
    if means.numel() == 0:
        return
    if means.device.type != "cpu":
        _assert_values(means, cholesky, colors, region_ids)
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
    if region_ids is not None and int(region_ids.min()) < 0:
        raise ValueError(f"region_ids must be non-negative; got {int(region_ids.min())}")


def _assert_values(means: Tensor, cholesky: Tensor, colors: Tensor, region_ids: Tensor | None) -> None:
    # written so that NaN fails
    ends = cholesky[..., ::2]
    least, most = SCALE_LIMITS[0] * (1 - 1e-6), SCALE_LIMITS[1]
    torch._assert_async((means.abs() <= MEAN_LIMIT).all(), f"means must be finite, within {MEAN_LIMIT:g} pixels")
    torch._assert_async(
        ((ends >= least) & (ends <= most)).all() & (cholesky[..., 1].abs() <= most).all(),
        f"cholesky must have l11, l22 in [{SCALE_LIMITS[0]:g}, {most:g}] pixels and |l21| at most {most:g}",
    )
    torch._assert_async(torch.isfinite(colors).all(), "colors must be finite")
    if region_ids is not None:
        torch._assert_async((region_ids >= 0).all(), "region_ids must be non-negative")
