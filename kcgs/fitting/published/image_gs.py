"""Image-GS's optimizer: Adam on centres, inverse scales, angles and colours."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs.nn import GaussianField

from .reparametrized import MIN_SIGMA, PublishedOptimizer


class ImageGSAdam(PublishedOptimizer):
    """Adam on centres in units of the image, inverse scales in 1 / pixel, rotation angles, and colours.

    Learning rates are constant over the fit. They are ours, for the publication blends the ten nearest Gaussians with
    normalised weights, and here they are summed.

    Source: Zhang et al., "Image-GS: Content-Adaptive Image Representation via 2D Gaussians", 2025.
    """

    learning_rates = (5e-4, 2e-3, 2e-3, 5e-3)

    def __init__(self, field: GaussianField, rate_factor: float) -> None:
        super().__init__(field, [rate * rate_factor for rate in self.learning_rates], torch.optim.Adam)

    def encode(self, field: GaussianField) -> list[Tensor]:
        """Return centres, inverse scales, angles and colours; round Gaussians have angle 0."""
        means, cholesky, colors = field.means.detach(), field.cholesky.detach(), field.merged_colors().detach()
        l11, l21, l22 = cholesky.unbind(-1)
        factor = torch.stack([l11, torch.zeros_like(l11), l21, l22], -1).unflatten(-1, (2, 2))
        axes, scales, _ = torch.linalg.svd(factor)
        angle = torch.atan2(axes[..., 1, 0], axes[..., 0, 0])
        return [means / self.extent, 1 / scales, angle[..., None], colors]

    def decode(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means, cholesky, colors."""
        centres, inverse_scales, angles, colors = self.parameters
        s1, s2 = (1 / inverse_scales.abs().clamp(1 / self.limit, 1 / MIN_SIGMA)).unbind(-1)
        cos, sin = torch.cos(angles[..., 0]), torch.sin(angles[..., 0])
        # R diag(s1, s2)^2 R^T = L L^T
        l11 = torch.sqrt((cos * s1) ** 2 + (sin * s2) ** 2)
        l21 = cos * sin * (s1**2 - s2**2) / l11
        return centres * self.extent, torch.stack([l11, l21, s1 * s2 / l11], -1), colors
