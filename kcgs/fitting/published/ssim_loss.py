"""Image-GS's objective."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs.functional import ssim
from kcgs.optim import AbsoluteError

# of 1 - SSIM beside the mean absolute error
_SSIM_WEIGHT = 0.1


class AbsoluteAndSsim(AbsoluteError):
    """L1 + 0.1 (1 - SSIM)."""

    power = None

    def slope(self, render: Tensor) -> Tensor:
        """Return the gradient, times the number of values."""
        leaf = render.clone().requires_grad_()
        with torch.enable_grad():
            (slope,) = torch.autograd.grad(ssim(leaf, self.image).sum(), leaf)
        return super().slope(render).sub_(_SSIM_WEIGHT * leaf.shape[-3:].numel() * slope)

    def value(self, render: Tensor) -> Tensor:
        """Return the weighted sum."""
        return super().value(render) + _SSIM_WEIGHT * (1 - ssim(render, self.image))
