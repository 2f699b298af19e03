"""Adam in each Gaussian's own frame."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from kcgs.fitting.frame import local_gradient, move, widen
from kcgs.nn import GaussianField

from .base import LEAST_SIGMA, GaussianOptimizer


class FrameAdam(GaussianOptimizer):
    """Adam in each Gaussian's own frame, so that one learning rate suits all sizes and every image.

    A step moves the centre by d mu = L d and the factor by L <- L exp(K), K lower triangular. Centres and scales are
    bounded: else a few Gaussians run away to 1e5 pixels, harmless to the render and ruinous to its numbers. None gets
    thinner than `least_sigma`, in pixels.
    """

    learning_rate = 0.14
    color_rate = 0.03
    betas = (0.9, 0.99)
    final_decay = 0.1
    largest_stretch = 0.5
    """The largest change of log scale, and of place in standard deviations, in one step."""
    outside = 2.0
    """How far outside the image a centre may lie, in its own standard deviations."""

    least_sigma = 0.5
    """Thinner Gaussians fit the pixels' centres better, and are dots and needles when a scene is enlarged."""

    def __init__(self, field: GaussianField, rate_factor: float) -> None:
        super().__init__(field)
        colors = self.raw[-1]
        rates = [self.learning_rate] * 5 + [self.color_rate] * colors.shape[1]
        self.rates = colors.detach().new_tensor(rates) * rate_factor
        self.momentum = self.rates.new_zeros(len(colors), len(self.rates))
        self.square = torch.zeros_like(self.momentum)
        self.age = self.rates.new_zeros(len(colors), 1)

    def encode(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> list[Tensor]:
        """Return the Gaussians as they are."""
        return [means, cholesky, colors]

    def gaussians(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the Gaussians."""
        means, cholesky, colors = self.raw
        return means, cholesky, colors

    def decay(self, progress: float) -> float:
        """Fall along a cosine."""
        height = 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
        return self.final_decay + (1 - self.final_decay) * height

    @torch.no_grad()
    def step(self, factor: float) -> None:
        """Move and forget the gradients."""
        means, cholesky, colors = self.raw
        gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in self.raw]
        local = torch.cat([local_gradient(cholesky, *gradients[:2]), gradients[2]], -1)
        beta1, beta2 = self.betas
        self.age += 1
        self.momentum.lerp_(local, 1 - beta1)
        self.square.mul_(beta2).addcmul_(local, local, value=1 - beta2)
        scale = (self.square / (1 - beta2**self.age)).sqrt_().add_(1e-12)
        change = self.momentum / (1 - beta1**self.age) / scale * (self.rates * -factor)
        step = change[:, :5].clamp(-self.largest_stretch, self.largest_stretch)
        self.set_raw([*self._bounded(*move(means, cholesky, step)), colors + change[:, 5:]])

    def _bounded(self, means: Tensor, cholesky: Tensor) -> tuple[Tensor, Tensor]:
        l11, l21, l22 = cholesky.unbind(-1)
        l11, l22 = l11.clamp(LEAST_SIGMA, self.limit), l22.clamp(LEAST_SIGMA, self.limit)
        l21 = l21.clamp(-self.limit, self.limit)
        reach = self.outside * torch.stack([l11, torch.hypot(l21, l22)], -1)
        means = torch.minimum(torch.maximum(means, -reach), self.extent + reach)
        return means, widen(torch.stack([l11, l21, l22], -1), self.least_sigma)

    @torch.no_grad()
    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Add Gaussians; their averages start from nothing."""
        super().append(*self._bounded(means, cholesky), colors)
        more = (0, 0, 0, len(means))
        self.momentum, self.square, self.age = (pad(t, more) for t in (self.momentum, self.square, self.age))

    def keep(self, mask: Tensor) -> None:
        """Leave out the others, and their averages."""
        super().keep(mask)
        self.momentum, self.square, self.age = (t[mask] for t in (self.momentum, self.square, self.age))

    def state_dict(self) -> dict[str, Any]:
        """Return Gaussians and averages."""
        return {**super().state_dict(), "momentum": self.momentum, "square": self.square, "age": self.age}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up Gaussians and averages."""
        super().load_state_dict(state)
        self.momentum, self.square, self.age = state["momentum"], state["square"], state["age"]
