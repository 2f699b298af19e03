"""An estimate of the bits of Gaussians, differentiable in their parameters."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs.codec import OPPONENT, Quantizer

# least product of the two standard deviations, in square pixels: smaller Gaussians count as Gaussians of this size,
# since for them sums over pixel centres differ from integrals
_MIN_SIGMA_PRODUCT = 0.25


def soft_bits(cholesky: Tensor, colors: Tensor, quantizer: Quantizer) -> Tensor:
    r"""Estimate the bits of each Gaussian, (N,), up to a constant, differentiably.

    A number with steps that add the distortion D (docs/format.md) has about :math:`\sqrt{1 + e / D}` steps, where e is
    the error of a change by its whole range:

    .. math:: 2 b = 2 \log_2(1 + \pi |c|^2 / D) + 2 \log_2(1 + E / D) + \log_2(1 + \sinh^2(2h) E / D)
        + \sum_k \log_2(1 + c_k^2 A / 12 D)

    The terms are, in order: centre; scale and ratio; angle; colours, in the opponent space of the file.
    :math:`E = A |c|^2` is the energy, :math:`A = \pi \sigma_1 \sigma_2` the area, :math:`2h = \ln(\sigma_1 /
    \sigma_2)`.

    Args:
        cholesky: (N, 3), in pixels.
        colors: (N, C), opacities merged.
        quantizer: of the file.

    Example:
        >>> quantizer = Quantizer(150, (480, 640))
        >>> circle, needle = torch.tensor([4.0, 0.0, 4.0]), torch.tensor([16.0, 0.0, 1.0])
        >>> bits = soft_bits(torch.stack([circle, needle]), torch.full((2, 3), 0.2), quantizer)
        >>> bool(bits[0] < bits[1])
        True
    """
    distortion = quantizer.distortion
    l11, l21, l22 = cholesky.unbind(-1)
    sigma_product = l11 * l22
    max_area = float(quantizer.size[0] * quantizer.size[1])
    area = (math.pi * sigma_product).clamp(math.pi * _MIN_SIGMA_PRODUCT, max_area)
    square = colors.square().sum(-1)
    energy = square * area / distortion
    sinh_square = ((0.5 * (l11**2 - l21**2 - l22**2)) ** 2 + (l11 * l21) ** 2) / sigma_product**2
    opponent = colors @ torch.tensor(OPPONENT).to(colors).T if colors.shape[1] == 3 else colors
    color_energies = opponent.square() * (area / (12.0 * distortion))[:, None]
    center_and_shape = 2 * torch.log2(1 + math.pi / distortion * square) + 2 * torch.log2(1 + energy)
    angle = torch.log2(1 + sinh_square * energy)
    return 0.5 * (center_and_shape + angle + torch.log2(1 + color_energies).sum(-1))
