"""From a network's output to Gaussians."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs._check import check_floating, check_number
from kcgs.errors import InvalidArgument

# largest factor in half spacings; the smallest is its inverse
_SCALE_RANGE = 8.0


def activate_gaussians(raw: Tensor, anchors: Tensor, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
    r"""Turn any real numbers, such as a network's output, into valid Gaussians near their anchors.

    Convention: zeros give a round black Gaussian at its anchor, with a standard deviation of half the spacing. With the
    spacing d, means lie within d of the anchor along x and along y, l11 and l22 in [d / 16, 4 d], and l21 in
    [-4 d, 4 d]. Colours are not changed: on a grid, the weights at a pixel add up to about pi / 2.

    Args:
        raw: two numbers of the mean, three of the factor, C of the colour, finite, :math:`(..., N, 5 + C)`.
        anchors: (x, y) in pixels, :math:`(N, 2)` or :math:`(..., N, 2)`.
        spacing: distance between neighbouring anchors in pixels, positive.

    Returns:
        Means, :math:`(..., N, 2)`, Cholesky factors, :math:`(..., N, 3)`, and colours, :math:`(..., N, C)`, as
        :func:`region_splat` and :class:`kcgs.GaussianField` take them, in float32, or float64 where `raw` is.

    Raises:
        TypeError, ValueError: wrong types or shapes; a spacing that is not positive.

    Example:
        >>> raw, anchors = torch.randn(4, 6, 8), torch.rand(6, 2) * 32
        >>> means, cholesky, colors = activate_gaussians(raw, anchors, spacing=4.0)
        >>> means.shape, cholesky.shape, colors.shape
        (torch.Size([4, 6, 2]), torch.Size([4, 6, 3]), torch.Size([4, 6, 3]))
    """
    check_floating("raw", raw, finite=False)
    check_floating("anchors", anchors, last=2, finite=False)
    check_number("spacing", spacing, 0.0, above=True)
    if raw.ndim < 2 or raw.shape[-1] < 6:
        raise InvalidArgument("raw", "shape (..., N, 5 + C)", tuple(raw.shape), verb="have")
    if anchors.shape[:-1] not in (raw.shape[:-1], raw.shape[-2:-1]):
        expected = f"shape ({raw.shape[-2]}, 2) or {(*raw.shape[:-1], 2)}"
        raise InvalidArgument("anchors", expected, tuple(anchors.shape), verb="have")
    raw = raw if raw.dtype == torch.float64 else raw.float()  # half precision cannot hold a pixel position
    log_range = math.log(_SCALE_RANGE)
    diagonal = torch.exp(log_range * torch.tanh(raw[..., 2:5:2] / log_range))
    shear = _SCALE_RANGE * torch.tanh(raw[..., 3] / _SCALE_RANGE)
    cholesky = 0.5 * spacing * torch.stack([diagonal[..., 0], shear, diagonal[..., 1]], -1)
    return anchors.to(raw) + spacing * torch.tanh(raw[..., :2]), cholesky, raw[..., 5:]
