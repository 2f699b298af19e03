r"""Forms of a 2D covariance: Cholesky factor, matrix, conic, scale and rotation, extent.

Convention: :math:`\Sigma = L L^T` with :math:`L = [[l_{11}, 0], [l_{21}, l_{22}]]`, stored as
``cholesky`` :math:`(..., 3) = (l_{11}, l_{21}, l_{22})` in pixels, :math:`l_{11}, l_{22} > 0`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs._check import check_floating, verify
from kcgs.errors import InvalidArgument


def check_cholesky(name: str, value: object) -> Tensor:
    """Return `value` if it is a finite (..., 3) tensor with positive l11 and l22."""
    cholesky = check_floating(name, value, last=3)
    if not verify((cholesky[..., ::2] > 0).all(), f"{name} must have l11 > 0 and l22 > 0"):
        least = f"a least of {cholesky[..., ::2].min().item():g}"
        hint = "kcgs.functional.activate_gaussians makes a network's output valid"
        raise InvalidArgument(name, "l11 > 0 and l22 > 0", f"{least}; {hint}", verb="have")
    return cholesky


def cholesky_to_covariance(cholesky: Tensor) -> Tensor:
    r"""Multiply out :math:`\Sigma = L L^T`.

    Args:
        cholesky: factors in pixels, :math:`(..., 3)`.

    Returns:
        Covariances in square pixels, :math:`(..., 2, 2)`.

    Raises:
        TypeError, ValueError: not a floating tensor; wrong last dimension, not finite, or l11, l22 not positive.

    Example:
        >>> cholesky_to_covariance(torch.tensor([2.0, 1.0, 3.0]))
        tensor([[ 4.,  2.],
                [ 2., 10.]])
    """
    l11, l21, l22 = check_cholesky("cholesky", cholesky).unbind(-1)
    cross = l11 * l21
    rows = [torch.stack([l11 * l11, cross], -1), torch.stack([cross, l21 * l21 + l22 * l22], -1)]
    return torch.stack(rows, -2)


def covariance_to_cholesky(covariance: Tensor) -> Tensor:
    r"""Factor :math:`\Sigma = L L^T`.

    Args:
        covariance: symmetric positive definite matrices in square pixels, :math:`(..., 2, 2)`. The upper right
            element is not read.

    Returns:
        Factors in pixels, :math:`(..., 3)`.

    Raises:
        TypeError, ValueError: not a floating tensor; wrong shape, not finite, or not positive definite.

    Example:
        >>> covariance_to_cholesky(torch.tensor([[4.0, 2.0], [2.0, 10.0]]))
        tensor([2., 1., 3.])
    """
    covariance = check_floating("covariance", covariance, last=2)
    if covariance.ndim < 2 or covariance.shape[-2] != 2:
        raise InvalidArgument("covariance", "shape (..., 2, 2)", tuple(covariance.shape), verb="have")
    s_xx, s_xy, s_yy = covariance[..., 0, 0], covariance[..., 1, 0], covariance[..., 1, 1]
    schur = s_yy - s_xy * s_xy / s_xx  # the Schur complement, l22 squared
    if not ((s_xx > 0) & (schur > 0)).all():
        raise InvalidArgument("covariance", "positive definite", "a matrix that is not")
    l11 = s_xx.sqrt()
    return torch.stack([l11, s_xy / l11, schur.sqrt()], -1)


def scale_rotation_to_cholesky(scales: Tensor, angle: Tensor) -> Tensor:
    r"""Factor the covariance :math:`R(\theta)\,\mathrm{diag}(s_1^2, s_2^2)\,R(\theta)^T`.

    Args:
        scales: standard deviations along the two axes in pixels, positive, :math:`(..., 2)`.
        angle: of the first axis from x towards y, radians, :math:`(...)`.

    Returns:
        Factors in pixels, :math:`(..., 3)`.

    Raises:
        TypeError, ValueError: not floating tensors; wrong shape, not finite, or a scale that is not positive.

    Example:
        >>> scale_rotation_to_cholesky(torch.tensor([3.0, 1.0]), torch.tensor(0.0))
        tensor([3., 0., 1.])
    """
    scales = check_floating("scales", scales, last=2)
    angle = check_floating("angle", angle)
    if not (scales > 0).all():
        raise InvalidArgument("scales", "positive", f"a least of {scales.min().item():g}")
    if scales.shape[:-1] != angle.shape:
        raise InvalidArgument("angle", f"shape {tuple(scales.shape[:-1])}", tuple(angle.shape), verb="have")
    s1, s2 = scales.unbind(-1)
    cos, sin = torch.cos(angle), torch.sin(angle)
    l11 = torch.hypot(s1 * cos, s2 * sin)
    # s1^2 - s2^2 as a product keeps nearly round Gaussians exact, det / l11 keeps needles positive
    return torch.stack([l11, (s1 - s2) * (s1 + s2) * sin * cos / l11, s1 * s2 / l11], -1)


def cholesky_to_scale_rotation(cholesky: Tensor) -> tuple[Tensor, Tensor]:
    r"""Find the axes of the ellipse.

    Args:
        cholesky: factors in pixels, :math:`(..., 3)`, as :func:`cholesky_to_covariance` takes them.

    Returns:
        Standard deviations (largest first) in pixels :math:`(..., 2)`, and the angle of the first axis from x
        towards y in radians, in (-pi/2, pi/2], :math:`(...)`.

    Example:
        >>> scales, angle = cholesky_to_scale_rotation(torch.tensor([1.0, 0.0, 3.0]))
        >>> scales, round(float(angle), 4)
        (tensor([3., 1.]), 1.5708)
    """
    l11, l21, l22 = check_cholesky("cholesky", cholesky).unbind(-1)
    # s1 + s2 and |s1 - s2| of the singular values of a triangular 2 x 2 matrix, without squaring
    total = torch.hypot(l11 + l22, l21)
    spread = torch.hypot(l11 - l22, l21)
    large = 0.5 * (total + spread)
    angle = 0.5 * torch.atan2(2 * l11 * l21, l11 * l11 - l21 * l21 - l22 * l22)
    return torch.stack([large, l11 * l22 / large], -1), angle
