r"""The arithmetic that all kernels share: whitened coordinates and what follows from them.

With Sigma = L L^T and d = p - mu, the exponent is q = |z|^2 with z = L^-1 d, by forward substitution

    z1 = dx / l11,    z2 = (dy - l21 z1) / l22.

This is a completed square taken from L itself: no conic is ever formed, so nothing cancels however stiff the Gaussian.
The gradient needs only the moments of z. With v = w * dLoss/dw,

    dLoss/dmu = L^-T sum(v z),    dLoss/dL = lower(L^-T sum(v z z^T)).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# |z| is cut here, where every weight is zero: its square is still finite in float32
Z_LIMIT = 1e15

# exp() of less is left out: it is zero in the dtype, or nothing beside the smallest colour step
_LOWEST_EXPONENT = {torch.float32: -80.0, torch.float64: -700.0}


def lowest_exponent(dtype: torch.dtype) -> float:
    """Exponent below which a weight is not evaluated, whatever the cutoff: also where torch.exp turns slow."""
    return _LOWEST_EXPONENT[dtype]


def support_radius(cutoff: float, dtype: torch.dtype) -> float:
    """Largest |z| at which a weight reaches `cutoff`; at cutoff 0, the largest that the dtype can tell from zero."""
    exponent = lowest_exponent(dtype) if cutoff <= 0.0 else max(math.log(cutoff), lowest_exponent(dtype))
    return math.sqrt(max(-2.0 * exponent, 0.0))


def moments_to_gradients(first: Tensor, second: Tensor, cholesky: Tensor) -> tuple[Tensor, Tensor]:
    """Turn moments of z into gradients.

    Args:
        first: sum of v z, (..., 2).
        second: sum of v (z1 z1, z1 z2, z2 z2), (..., 3).
        cholesky: (..., 3).

    Returns:
        Gradients of the means (..., 2) and of the Cholesky factors (..., 3), in the dtype of `cholesky`.
    """
    l11, l21, l22 = cholesky.double().unbind(-1)
    s1, s2 = first.double().unbind(-1)
    s11, s12, s22 = second.double().unbind(-1)
    slope = l21 / l22
    means = torch.stack([(s1 - slope * s2) / l11, s2 / l22], -1)
    factors = torch.stack([(s11 - slope * s12) / l11, s12 / l22, s22 / l22], -1)
    return means.to(cholesky.dtype), factors.to(cholesky.dtype)
