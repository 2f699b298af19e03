"""Gaussians as numbers of order one, for networks."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs._check import check_floating, check_rows, check_size
from kcgs.errors import InvalidArgument

from .covariance import check_cholesky

# columns of a token besides the colours
_NUM_GEOMETRY = 5


def to_tokens(means: Tensor, cholesky: Tensor, colors: Tensor, size: tuple[int, int] | Tensor) -> Tensor:
    r"""Write Gaussians as tokens; :func:`from_tokens` is the inverse, to rounding.

    Convention: a token is :math:`(2x/w - 1, 2y/h - 1, \ln(l_{11}/s), l_{21}/(l_{11} + l_{22}), \ln(l_{22}/s), c)` with
    :math:`s = \sqrt{hw}`. Centres in the image are in [-1, 1]; a fit lets them lie a little outside.

    Args:
        means: (x, y) in pixels, :math:`(..., N, 2)`.
        cholesky: (l11, l21, l22) in pixels, :math:`(..., N, 3)`.
        colors: with opacities multiplied in, :math:`(..., N, C)`.
        size: (height, width) of the image, or of each image, :math:`(..., 2)`.

    Returns:
        :math:`(..., N, 5 + C)`, with the graph; half precision is computed and returned in float32.

    Raises:
        TypeError, ValueError: not floating tensors; shapes that do not fit, values that are not finite, l11 or l22 that
            are not positive, or a size that is not two positive integers.

    Example:
        >>> means, cholesky = torch.tensor([[12.0, 8.0]]), torch.tensor([[2.0, 1.0, 2.0]])
        >>> to_tokens(means, cholesky, torch.tensor([[0.5]]), (16, 24))
        tensor([[ 0.0000,  0.0000, -2.2822,  0.2500, -2.2822,  0.5000]])
    """
    means = check_floating("means", means, last=2)
    check_rows("cholesky", check_cholesky("cholesky", cholesky), means, 3)
    check_rows("colors", check_floating("colors", colors), means, "C")
    extent, side = _extent(means, size)
    l11, l21, l22 = cholesky.unbind(-1)
    shape = torch.stack([torch.log(l11 / side), l21 / (l11 + l22), torch.log(l22 / side)], -1)
    return torch.cat([2.0 * means / extent - 1.0, shape, colors], -1)


def from_tokens(tokens: Tensor, size: tuple[int, int] | Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Read means, factors and colours from tokens, :math:`(..., N, 5 + C)`, with the graph: see :func:`to_tokens`.

    Any finite numbers give valid Gaussians, as long as the exponentials do not overflow. Half precision is computed and
    returned in float32.

    Raises:
        TypeError, ValueError: not a floating tensor; no column of a colour; a size that is not two positive integers.
    """
    tokens = check_floating("tokens", tokens, finite=False)
    if tokens.ndim < 2 or tokens.shape[-1] <= _NUM_GEOMETRY:
        raise InvalidArgument("tokens", "5 + C columns", tuple(tokens.shape), verb="have")
    tokens = tokens.to(torch.promote_types(tokens.dtype, torch.float32))
    extent, side = _extent(tokens, size)
    x, y, log11, slant, log22 = tokens[..., :_NUM_GEOMETRY].unbind(-1)
    l11, l22 = torch.exp(log11) * side, torch.exp(log22) * side
    means = 0.5 * (torch.stack([x, y], -1) + 1.0) * extent
    return means, torch.stack([l11, slant * (l11 + l22), l22], -1), tokens[..., _NUM_GEOMETRY:]


def _extent(table: Tensor, size: tuple[int, int] | Tensor) -> tuple[Tensor, Tensor]:
    """Return (width, height) and the root of the area, which broadcast to tables (..., N, K) and to their columns."""
    size = size if isinstance(size, Tensor) else check_size("size", size)
    dtype = torch.promote_types(table.dtype, torch.float32)  # half precision cannot hold the area of an image
    sizes = torch.as_tensor(size, dtype=dtype, device=table.device).unsqueeze(-2)
    return sizes.flip(-1), sizes.prod(-1).sqrt()
