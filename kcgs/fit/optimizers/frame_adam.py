"""Adam in each Gaussian's own frame."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from kcgs.fit.frame import local_gradient, move
from kcgs.nn import GaussianField

from .base import LARGEST_COLOR, LEAST_SIGMA


class FrameAdam:
    r"""Adam in each Gaussian's own frame.

    A step moves the centre by d mu = L d and the factor by L <- L exp(K), K lower triangular: steps are fractions of
    the Gaussian's own size and shape, so that one learning rate suits all sizes and every image. Centres stay within
    the image plus two of their standard deviations, and scales between 0.1 pixels and the image diagonal: without
    bounds a few Gaussians run away to 1e5 pixels, harmless to the render and ruinous to its numbers. The learning rates
    fall to a tenth along a cosine.

    Args:
        field: the start.
        rate_factor: factor on the learning rates.
    """

    learning_rate = 0.1
    color_rate = 0.03
    betas = (0.9, 0.99)
    final_decay = 0.1
    largest_stretch = 0.5
    """The largest change of log scale, and of place in standard deviations, in one step."""
    outside = 2.0
    """How far outside the image a centre may lie, in its own standard deviations."""
    widest = 1.0
    """Image diagonals; a wider Gaussian is a constant."""

    def __init__(self, field: GaussianField, rate_factor: float) -> None:
        height, width = field.size
        self.extent = field.means.new_tensor([width, height])
        self.limit = self.widest * math.hypot(height, width)
        colors = field.merged_colors().detach().clone()
        rates = [self.learning_rate] * 5 + [self.color_rate] * colors.shape[1]
        self.rates = colors.new_tensor(rates) * rate_factor
        self._set(field.means.detach().clone(), field.cholesky.detach().clone(), colors)
        self.momentum = colors.new_zeros(len(colors), 5 + colors.shape[1])
        self.square = torch.zeros_like(self.momentum)
        self.age = colors.new_zeros(len(colors), 1)

    def _set(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        self.means, self.cholesky, self.colors = (t.detach().requires_grad_() for t in (means, cholesky, colors))

    def gaussians(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the Gaussians."""
        return self.means, self.cholesky, self.colors

    def decay(self, progress: float) -> float:
        """Fall along a cosine."""
        height = 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
        return self.final_decay + (1 - self.final_decay) * height

    @torch.no_grad()
    def step(self, factor: float) -> None:
        """Move and forget the gradients."""
        gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in self.gaussians()]
        local = torch.cat([local_gradient(self.cholesky, *gradients[:2]), gradients[2]], -1)
        beta1, beta2 = self.betas
        self.age += 1
        self.momentum.lerp_(local, 1 - beta1)
        self.square.mul_(beta2).addcmul_(local, local, value=1 - beta2)
        scale = (self.square / (1 - beta2**self.age)).sqrt_().add_(1e-12)
        change = self.momentum / (1 - beta1**self.age) / scale * (self.rates * -factor)
        step = change[:, :5].clamp(-self.largest_stretch, self.largest_stretch)
        self._set(*self._bounded(*move(self.means, self.cholesky, step)), self.colors + change[:, 5:])

    def _bounded(self, means: Tensor, cholesky: Tensor) -> tuple[Tensor, Tensor]:
        l11, l21, l22 = cholesky.unbind(-1)
        l11, l22 = l11.clamp(LEAST_SIGMA, self.limit), l22.clamp(LEAST_SIGMA, self.limit)
        l21 = l21.clamp(-self.limit, self.limit)
        reach = self.outside * torch.stack([l11, torch.hypot(l21, l22)], -1)
        return torch.minimum(torch.maximum(means, -reach), self.extent + reach), torch.stack([l11, l21, l22], -1)

    @torch.no_grad()
    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Add Gaussians; their averages start from nothing."""
        added = (*self._bounded(means, cholesky), colors)
        self._set(*(torch.cat([old.detach(), new]) for old, new in zip(self.gaussians(), added, strict=True)))
        more = (0, 0, 0, len(means))
        self.momentum, self.square, self.age = (pad(t, more) for t in (self.momentum, self.square, self.age))

    def recolor(self, colors: Tensor) -> None:
        """Replace the colours."""
        self._set(self.means, self.cholesky, colors)

    def is_finite(self) -> bool:
        """Say whether every number is finite, and colours far from overflow."""
        finite = torch.isfinite(self.means).all() & torch.isfinite(self.cholesky).all()
        return bool(finite & (self.colors.detach().abs() < LARGEST_COLOR).all())

    def state_dict(self) -> dict[str, Any]:
        """Return Gaussians and averages."""
        gaussians = [t.detach() for t in self.gaussians()]
        return {"gaussians": gaussians, "momentum": self.momentum, "square": self.square, "age": self.age}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up Gaussians and averages."""
        self._set(*state["gaussians"])
        self.momentum, self.square, self.age = state["momentum"], state["square"], state["age"]
