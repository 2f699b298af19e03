"""A Gaussian's own frame, in which steps are fractions of its size and shape, so that one rate suits all sizes.

A step (d, K) moves a centre by L d and a factor L to L exp K. K is lower triangular.
"""

from __future__ import annotations

import torch
from torch import Tensor


def local_gradient(cholesky: Tensor, means_gradient: Tensor, cholesky_gradient: Tensor) -> Tensor:
    """Return the gradient by (d1, d2, k11, k21, k22) at step 0, (..., N, 5)."""
    l11, l21, l22 = cholesky.unbind(-1)
    gx, gy = means_gradient.unbind(-1)
    g11, g21, g22 = cholesky_gradient.unbind(-1)
    return torch.stack([l11 * gx + l21 * gy, l22 * gy, l11 * g11 + l21 * g21, l22 * g21, l22 * g22], -1)


def move(means: Tensor, cholesky: Tensor, step: Tensor, *, exact: bool = True) -> tuple[Tensor, Tensor]:
    """Take a step (..., N, 5), (d1, d2, k11, k21, k22); return means and factors.

    `exact` uses exp K; False uses exp K to first order in k21, as Newton's method does.
    """
    d1, d2, k11, k21, k22 = step.unbind(-1)
    l11, l21, l22 = cholesky.unbind(-1)
    means = means + torch.stack([l11 * d1, l21 * d1 + l22 * d2], -1)
    e1, e2 = torch.exp(k11), torch.exp(k22)
    sheared = l22 * k21
    if exact:  # the mean of exp between k11 and k22
        gap = k11 - k22
        mean = torch.where(gap.abs() < 1e-4, 0.5 * (e1 + e2), (e1 - e2) / torch.where(gap == 0, 1.0, gap))
        sheared = sheared * mean
    return means, torch.stack([l11 * e1, l21 * e1 + sheared, l22 * e2], -1)


def widen(cholesky: Tensor, min_sigma: float) -> Tensor:
    """Raise standard deviations below a bound, in pixels, to it, along the axes of each ellipse, (..., N, 3)."""
    l11, l21, l22 = cholesky.unbind(-1)
    xx, xy, yy = l11**2, l11 * l21, l21**2 + l22**2
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    gap = torch.hypot(half, xy)
    long, short = mean + gap, (l11 * l22) ** 2 / (mean + gap)
    new_long, new_short = long.clamp_min(min_sigma**2), short.clamp_min(min_sigma**2)
    # variance added along both axes, and along the shorter one alone; a circle has any axes
    isotropic, minor = new_long - long, (new_short - short) - (new_long - long)
    cos, sin = (torch.where(gap > 0, part / gap, 0.0) for part in (half, xy))
    w11 = (xx + isotropic + 0.5 * minor * (1 - cos)).sqrt()
    widened = torch.stack([w11, (xy - 0.5 * minor * sin) / w11, (new_long * new_short).sqrt() / w11], -1)
    return torch.where((short < min_sigma**2)[..., None], widened, cholesky)
