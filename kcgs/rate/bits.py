"""How many bits Gaussians take, as a smooth function of what they are, so that a descent can spare them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs.codec.gaussians.quantize import OPPONENT, Quantizer

# square pixels: smaller ones are no cheaper, since their sums over pixel centres are nothing like integrals
_LEAST_PRODUCT = 0.25


def soft_bits(cholesky: Tensor, colors: Tensor, quantizer: Quantizer) -> Tensor:
    r"""Return about how many bits each Gaussian takes beyond what all take, (N,), differentiable.

    A number whose steps add the distortion D each (docs/format.md) has about :math:`\sqrt{1 + e / D}` of them, with e
    what a change of its whole range would add:

    .. math:: 2 b = 2 \log_2(1 + \pi |c|^2 / D) + 2 \log_2(1 + E / D) + \log_2(1 + \sinh^2(2h) E / D)
        + \sum_k \log_2(1 + c_k^2 A / 12 D)

    for the two numbers of the centre, scale and ratio, the angle, and the colours, rotated as they are coded; :math:`E
    = A |c|^2` is the energy, :math:`A = \pi \sigma_1 \sigma_2` the area, :math:`2h = \ln(\sigma_1 / \sigma_2)`.

    Args:
        cholesky: (N, 3), in pixels.
        colors: (N, C), opacities merged.
        quantizer: of the file.

    Example:
        >>> quantizer = Quantizer(150, (480, 640))
        >>> round_one, needle = torch.tensor([4.0, 0.0, 4.0]), torch.tensor([16.0, 0.0, 1.0])
        >>> bits = soft_bits(torch.stack([round_one, needle]), torch.full((2, 3), 0.2), quantizer)
        >>> bool(bits[0] < bits[1])
        True
    """
    distortion = quantizer.distortion
    l11, l21, l22 = cholesky.unbind(-1)
    product = l11 * l22
    area = (math.pi * product).clamp(math.pi * _LEAST_PRODUCT, float(quantizer.size[0] * quantizer.size[1]))
    strength = colors.square().sum(-1)
    energy = strength * area / distortion
    stretch = ((0.5 * (l11**2 - l21**2 - l22**2)) ** 2 + (l11 * l21) ** 2) / product**2
    rotated = colors @ torch.tensor(OPPONENT).to(colors).T if colors.shape[1] == 3 else colors
    parts = rotated.square() * (area / (12.0 * distortion))[:, None]
    twice = 2 * torch.log2(1 + math.pi / distortion * strength) + 2 * torch.log2(1 + energy)
    return 0.5 * (twice + torch.log2(1 + stretch * energy) + torch.log2(1 + parts).sum(-1))
