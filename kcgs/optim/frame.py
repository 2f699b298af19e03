"""A Gaussian's own frame: steps that are fractions of its size and shape, so that one rate suits all sizes."""

from __future__ import annotations

import torch
from torch import Tensor


def local_gradient(cholesky: Tensor, means_gradient: Tensor, cholesky_gradient: Tensor) -> Tensor:
    """Express a gradient in each Gaussian's frame, (N, 5): by the step of :func:`move`, at none."""
    l11, l21, l22 = cholesky.unbind(-1)
    gx, gy = means_gradient.unbind(-1)
    g11, g21, g22 = cholesky_gradient.unbind(-1)
    return torch.stack([l11 * gx + l21 * gy, l22 * gy, l11 * g11 + l21 * g21, l22 * g21, l22 * g22], -1)


def widen(cholesky: Tensor, least_sigma: float) -> Tensor:
    """Make Gaussians (..., N, 3) no thinner than this, in pixels, in any direction; those that are wide enough stay.

    The variances along the axes of the ellipse are raised, and the axes stay.
    """
    l11, l21, l22 = cholesky.unbind(-1)
    xx, xy, yy = l11**2, l11 * l21, l21**2 + l22**2
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    gap = torch.hypot(half, xy)
    long, short = mean + gap, (l11 * l22) ** 2 / (mean + gap)
    new_long, new_short = long.clamp_min(least_sigma**2), short.clamp_min(least_sigma**2)
    # what is added along both axes, and along the shorter one alone; a circle has any axes
    both, more = new_long - long, (new_short - short) - (new_long - long)
    cos, sin = (torch.where(gap > 0, part / gap, 0.0) for part in (half, xy))
    w11 = (xx + both + 0.5 * more * (1 - cos)).sqrt()
    widened = torch.stack([w11, (xy - 0.5 * more * sin) / w11, (new_long * new_short).sqrt() / w11], -1)
    return torch.where((short < least_sigma**2)[..., None], widened, cholesky)


def move(means: Tensor, cholesky: Tensor, step: Tensor, *, exact: bool = True) -> tuple[Tensor, Tensor]:
    """Move Gaussians by (d1, d2, k11, k21, k22) in their own frames: centres by L d, factors to L exp K.

    K is lower triangular. `exact` takes exp K as it is; False: to first order in k21, for steps that a solver chose so.
    """
    d1, d2, k11, k21, k22 = step.unbind(-1)
    l11, l21, l22 = cholesky.unbind(-1)
    means = means + torch.stack([l11 * d1, l21 * d1 + l22 * d2], -1)
    e1, e2 = torch.exp(k11), torch.exp(k22)
    sheared = l22 * k21
    if exact:  # the mean of exp between k11 and k22
        gap = k11 - k22
        sheared = sheared * torch.where(gap.abs() < 1e-4, 0.5 * (e1 + e2), (e1 - e2) / torch.where(gap == 0, 1.0, gap))
    return means, torch.stack([l11 * e1, l21 * e1 + sheared, l22 * e2], -1)
