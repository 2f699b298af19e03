"""Whitened coordinates z = L^-1 (p - mu) by forward substitution, and gradients from their moments.

All kernels share this arithmetic; docs/performance.md has the formulas.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .inputs import Gradients

# |z| is cut here, where every weight is zero: its square is still finite in float32
Z_LIMIT = 1e15

# arithmetic in float32 stays finite inside these bounds of means and factors, which are far beyond any image
MEAN_LIMIT = 1e8
SCALE_LIMITS = (1e-6, 1e8)

# exp() of less is left out: it is zero in the dtype, or nothing beside the smallest colour step
_LOWEST_EXPONENT = {4: -80.0, 8: -700.0}  # by the bytes of the dtype


def least_exponent(cutoff: float, dtype: torch.dtype) -> float:
    """Exponent below which a weight is not evaluated; at cutoff 0 where exp() turns slow, and zero in the dtype."""
    lowest = _LOWEST_EXPONENT[dtype.itemsize]
    return max(math.log(cutoff), lowest) if cutoff > 0.0 else lowest


def support_radius(cutoff: float, dtype: torch.dtype) -> float:
    """Largest |z| at which a weight reaches `cutoff`; at cutoff 0, the largest that the dtype can tell from zero."""
    return math.sqrt(max(-2.0 * least_exponent(cutoff, dtype), 0.0))


def sums_to_gradients(sums: Tensor, channels: int, cholesky: Tensor) -> Gradients:
    """Turn sums over the pixels into gradients of means, factors (None each where not asked for) and colours.

    With g = dLoss/dI and v = w g^T c the sums are of w g, (..., C), and, where geometry is asked for, of
    v (z1, z2, z1 z1, z1 z2, z2 z2), (..., C + 5).
    """
    colors = sums[..., :channels]
    if sums.shape[-1] == channels:
        return None, None, colors
    l11, l21, l22 = cholesky.double().unbind(-1)
    s1, s2, s11, s12, s22 = sums[..., channels:].double().unbind(-1)
    slope = l21 / l22
    means = torch.stack([(s1 - slope * s2) / l11, s2 / l22], -1)
    factors = torch.stack([(s11 - slope * s12) / l11, s12 / l22, s22 / l22], -1)
    return means.to(cholesky.dtype), factors.to(cholesky.dtype), colors
