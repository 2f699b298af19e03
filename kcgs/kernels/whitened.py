"""Whitened coordinates z = L^-1 (p - mu) by forward substitution, and gradients from their moments.

All kernels, the public checks and the ONNX graphs share these limits; docs/performance.md has the formulas.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from kcgs._arithmetic import Numbers

from .interface import Gradients
from .moments import geometry_gradient

# if z is multiplied by this, the weight exp(-|z|^2 / 2) is 2^(-|z|^2)
SCALE = math.sqrt(0.5 / math.log(2.0))

# |z| is clamped here, where every weight is zero: its square is still finite in float32
Z_LIMIT = 1e15

# largest coordinate of a mean, in pixels: arithmetic in float32 stays finite
MEAN_LIMIT = 1e8
# least and largest l11 and l22, in pixels, for the same reason
SCALE_LIMITS = (1e-6, 1e8)
# relative tolerance of the least scale, for rounding; and the least scale with it in float32, which all checks use
SCALE_TOLERANCE = 1e-6
LEAST_SCALE = float(np.float32(SCALE_LIMITS[0] * (1 - SCALE_TOLERANCE)))

# by the bytes of the dtype: exp() of a smaller exponent is zero, or far below the smallest colour step
_LEAST_EXPONENT = {4: -80.0, 8: -700.0}


def least_exponent(cutoff: float, dtype: torch.dtype) -> float:
    """Return the exponent below which a weight is 0: log(cutoff), or the limit of the dtype where that is larger."""
    least = _LEAST_EXPONENT[dtype.itemsize]
    return max(math.log(cutoff), least) if cutoff > 0.0 else least


def support_radius(cutoff: float, dtype: torch.dtype) -> float:
    """Return the largest |z| at which a weight reaches `cutoff`, or, at cutoff 0, is not zero in the dtype."""
    return math.sqrt(max(-2.0 * least_exponent(cutoff, dtype), 0.0))


def whiten(x: Numbers, y: Numbers, k1: Numbers, slope: Numbers, k2: Numbers) -> tuple[Numbers, Numbers]:
    """Return z1 and z2 at offsets from the mean; k1, slope and k2 are 1 / l11, l21 / l11 and 1 / l22."""
    return x * k1, (y - slope * x) * k2


def affine_coefficients(
    x: Numbers, y: Numbers, l11: Numbers, l21: Numbers, l22: Numbers
) -> tuple[Numbers, Numbers, Numbers, Numbers, Numbers]:
    """Return k of z1 = k0 + k1 u, z2 = k2 + k3 u + k4 v, for (u, v) from a point that is (x, y) from the mean."""
    slope = l21 / l11
    k0, k1, k4 = x / l11, l11.reciprocal(), l22.reciprocal()
    k2 = (y - slope * x) / l22
    return k0, k1, k2, -(slope / l22), k4


def least_shear(x: Numbers, y: Numbers, slope: Numbers, half: float) -> Numbers:
    """Return the least |y - slope x| over a square with middle (x, y); below 0 where y - slope x has both signs.

    The support of a slanted needle is thin in z2: it reaches few of the squares that its bounding box touches.
    """
    return (y - slope * x).abs() - (slope.abs() + 1) * half


def least_whitened(
    x: Numbers, y: Numbers, k1: Numbers, slope: Numbers, k2: Numbers, half: float
) -> tuple[Numbers, Numbers]:
    """Return the least |z1| and |z2| over a square with middle (x, y); below 0 where a coordinate has both signs."""
    return (x.abs() - half) * k1, least_shear(x, y, slope, half) * k2


def sums_to_gradients(sums: Tensor, channels: int, cholesky: Tensor) -> Gradients:
    """Turn sums over the pixels into gradients of means, factors and colours.

    With g = dLoss/dI and v = w g^T c the sums are of w g, (..., C), or of w g and of v (z1, z2, z1 z1, z1 z2, z2 z2),
    (..., C + 5). From w g alone, the gradients of means and factors are None.
    """
    colors = sums[..., :channels]
    if sums.shape[-1] == channels:
        return None, None, colors
    moments = sums[..., channels:].double().unbind(-1)
    x, y, *factor = geometry_gradient(*moments, *cholesky.double().unbind(-1))  # type: ignore[no-untyped-call]
    means, factors = (torch.stack(columns, -1).to(cholesky.dtype) for columns in ([x, y], factor))
    return means, factors, colors
