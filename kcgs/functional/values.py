"""Checks of values, which only an operator sees: finite, and in the range where float32 stays finite."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument
from kcgs.kernels import MEAN_LIMIT, SCALE_LIMITS, SCALE_TOLERANCE

_OUT_OF_RANGE = (
    "Where an optimizer's step made them so, take a smaller learning rate, or kcgs.optim.GaussianAdam, which keeps a "
    "field valid; kcgs.functional.activate_gaussians makes a network's output valid"
)
_NOT_FINITE = "A loss or a gradient that is not finite, or a learning rate that is far too large, makes parameters so"


def check_values(means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
    """Refuse values that are not finite or out of range."""
    if means.numel() == 0:
        return
    (least, most), diagonal, l21 = SCALE_LIMITS, cholesky[..., ::2], cholesky[..., 1]
    bounds = f"finite, l11 and l22 in [{least:g}, {most:g}] pixels and |l21| at most {most:g}"
    # comparisons with NaN must fail
    in_range = (diagonal >= least * (1 - SCALE_TOLERANCE)) & (diagonal <= most)
    _check("means", means, means.abs() <= MEAN_LIMIT, f"finite, within {MEAN_LIMIT:g} pixels")
    _check("cholesky", diagonal, in_range, bounds, "l11 and l22 in ")
    _check("cholesky", l21, l21.abs() <= most, bounds, "l21 in ")
    _check("colors", colors, colors.isfinite(), "finite")


def _check(name: str, values: Tensor, valid: Tensor, expected: str, part: str = "") -> None:
    if not valid.all():
        count, (low, high) = int((~values.isfinite()).sum()), torch.aminmax(values)
        extremes = f"{part}[{float(low):g}, {float(high):g}]. {_OUT_OF_RANGE}"
        raise InvalidArgument(name, expected, f"{count} NaN or infinite values. {_NOT_FINITE}" if count else extremes)


def check_region_ids(region_ids: Tensor, index: Tensor) -> None:
    """Refuse negative ids, and warn of Gaussians whose id is not in the map: their `index`, (B, N), is negative."""
    if not region_ids.numel():
        return
    if int(region_ids.min()) < 0:
        raise InvalidArgument("region_ids", "non-negative", int(region_ids.min()))
    foreign = region_ids.view_as(index)[index < 0]
    if len(foreign):
        warn_user(
            f"{len(foreign)} of {index.numel()} Gaussians paint nothing: regions does not hold their region ids, such "
            f"as {int(foreign[0])}; pass the map that they belong to, or call field.assign_regions(regions)"
        )
