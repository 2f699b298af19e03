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
