"""What moves the Gaussians: parameters, their bounds, and the step downhill."""

from __future__ import annotations

import math
from typing import Any, Protocol

import torch
from torch import Tensor

from kcgs.nn import GaussianField

from .adan import Adan
from .config import FitConfig
from .parameters import RawParameters

# wider than this many image diagonals, a Gaussian is a constant
_MOST_DIAGONALS = 1.0
# how far outside the image a centre may lie, in its own standard deviations
_OUTSIDE = 2.0
# thinner than this, a Gaussian falls between the pixel centres
_LEAST_SIGMA = 0.1
_LARGEST_COLOR = 1e15
# rates of geometry and of colours in the frame, and the decay of the averages
_RATE, _COLOR_RATE = 0.1, 0.03
_BETAS = 0.9, 0.99
# the published rate, and the iterations that it is meant for
_PUBLISHED_RATE, _PUBLISHED_ITERATIONS = 1e-3, 50_000
# the largest change of log scale in one step
_LARGEST_STRETCH = 0.5


class Descent(Protocol):
    """Gaussians that can be drawn, differentiated, and moved downhill."""

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means (N, 2), cholesky (N, 3), colors (N, C), which carry the graph."""

    def step(self, factor: float) -> None:
        """Move by the gradients of the last backward, at `factor` times the learning rate, and forget them."""

    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Add Gaussians."""

    def recolor(self, colors: Tensor) -> None:
        """Replace the colours."""

    def is_finite(self) -> bool:
        """Say whether every number is finite, and colours far from overflow."""

    def state(self) -> dict[str, Any]:
        """Return everything a resumed fit needs, as tensors and numbers."""

    def load(self, state: dict[str, Any]) -> None:
        """Take up a state."""


def make_descent(config: FitConfig, field: GaussianField, sigma: float) -> Descent:
    """Make the descent that the settings ask for, from a start whose Gaussians are about `sigma` pixels wide."""
    return FrameDescent(config, field) if config.optimizer == "frame" else RawDescent(config, field, sigma)


def _published_rate(config: FitConfig) -> float:
    """GaussianImage's rate: a shorter run takes larger steps, by the root of the ratio, up to twentyfold."""
    longer = min(20.0, math.sqrt(max(1.0, _PUBLISHED_ITERATIONS / config.iterations)))
    return _PUBLISHED_RATE * longer * config.learning_rate_factor


class RawDescent:
    """A torch optimiser on GaussianImage's parameters."""

    def __init__(self, config: FitConfig, field: GaussianField, sigma: float) -> None:
        self.raw = RawParameters(field)
        groups = self.raw.groups(_published_rate(config), sigma)
        self.optimizer = Adan(groups) if config.optimizer == "adan" else torch.optim.Adam(groups)
        self.rates = [group["lr"] for group in self.optimizer.param_groups]

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the Gaussians."""
        return self.raw.tensors()

    def step(self, factor: float) -> None:
        """Move and forget the gradients."""
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Refuse: these parameters do not grow."""
        raise NotImplementedError("only optimizer 'frame' grows")

    def recolor(self, colors: Tensor) -> None:
        """Replace the colours."""
        with torch.no_grad():
            self.raw.colors.copy_(colors)

    def is_finite(self) -> bool:
        """Say whether every number is finite."""
        return self.raw.is_finite()

    def state(self) -> dict[str, Any]:
        """Return parameters and optimiser."""
        return {"raw": self.raw.state(), "optimizer": self.optimizer.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        """Take up parameters and optimiser."""
        self.raw.load(state["raw"])
        self.optimizer.load_state_dict(state["optimizer"])


class FrameDescent:
    r"""Adam in each Gaussian's own frame.

    A step moves the centre by d mu = L d and the factor by L <- L exp(K), K lower triangular: steps are fractions of
    the Gaussian's own size and shape, so that one learning rate suits all sizes and every image. Centres stay within
    the image plus two of their standard deviations, and scales between 0.1 pixels and the image diagonal: without
    bounds a few Gaussians run away to 1e5 pixels, harmless to the picture and ruinous to its numbers.
    """

    def __init__(self, config: FitConfig, field: GaussianField) -> None:
        height, width = field.size
        self.extent = field.means.new_tensor([width, height])
        self.limit = _MOST_DIAGONALS * math.hypot(height, width)
        means, cholesky = field.means.detach().clone(), field.cholesky.detach().clone()
        colors = field.merged_colors().detach().clone()
        self.rates = colors.new_tensor([_RATE] * 5 + [_COLOR_RATE] * colors.shape[1]) * config.learning_rate_factor
        self._hold(means, cholesky, colors)
        self.momentum = colors.new_zeros(len(colors), 5 + colors.shape[1])
        self.square = torch.zeros_like(self.momentum)
        self.age = colors.new_zeros(len(colors), 1)

    def _hold(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        self.means, self.cholesky, self.colors = (t.detach().requires_grad_() for t in (means, cholesky, colors))

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the Gaussians."""
        return self.means, self.cholesky, self.colors

    @torch.no_grad()
    def step(self, factor: float) -> None:
        """Move and forget the gradients."""
        l11, l21, l22 = self.cholesky.unbind(-1)
        local = self._local_gradient(l11, l21, l22)
        beta1, beta2 = _BETAS
        self.age += 1
        self.momentum.lerp_(local, 1 - beta1)
        self.square.mul_(beta2).addcmul_(local, local, value=1 - beta2)
        scale = (self.square / (1 - beta2**self.age)).sqrt_().add_(1e-12)
        move = self.momentum / (1 - beta1**self.age) / scale * (self.rates * factor)
        d1, d2, k11, k21, k22 = move[:, :5].clamp(-_LARGEST_STRETCH, _LARGEST_STRETCH).unbind(-1)
        means = self.means - torch.stack([l11 * d1, l21 * d1 + l22 * d2], -1)
        # exp of -[[k11, 0], [k21, k22]]
        e1, e2 = torch.exp(-k11), torch.exp(-k22)
        gap = k11 - k22
        mean_slope = torch.where(gap.abs() < 1e-4, 0.5 * (e1 + e2), (e2 - e1) / torch.where(gap == 0, 1.0, gap))
        cholesky = torch.stack([l11 * e1, l21 * e1 - l22 * k21 * mean_slope, l22 * e2], -1)
        self._hold(*self._bounded(means, cholesky), self.colors - move[:, 5:])

    def _local_gradient(self, l11: Tensor, l21: Tensor, l22: Tensor) -> Tensor:
        gx, gy = self._gradient(self.means).unbind(-1)
        g11, g21, g22 = self._gradient(self.cholesky).unbind(-1)
        frame = [l11 * gx + l21 * gy, l22 * gy, l11 * g11 + l21 * g21, l22 * g21, l22 * g22]
        return torch.cat([torch.stack(frame, -1), self._gradient(self.colors)], -1)

    @staticmethod
    def _gradient(tensor: Tensor) -> Tensor:
        return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad

    def _bounded(self, means: Tensor, cholesky: Tensor) -> tuple[Tensor, Tensor]:
        l11, l21, l22 = cholesky.unbind(-1)
        l11, l22 = l11.clamp(_LEAST_SIGMA, self.limit), l22.clamp(_LEAST_SIGMA, self.limit)
        l21 = l21.clamp(-self.limit, self.limit)
        reach = _OUTSIDE * torch.stack([l11, torch.hypot(l21, l22)], -1)
        return torch.minimum(torch.maximum(means, -reach), self.extent + reach), torch.stack([l11, l21, l22], -1)

    @torch.no_grad()
    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Add Gaussians; their averages start from nothing."""
        means, cholesky = self._bounded(means, cholesky)
        pairs = zip(self.tensors(), (means, cholesky, colors), strict=True)
        self._hold(*(torch.cat([old.detach(), new]) for old, new in pairs))
        more = (0, 0, 0, len(means))
        self.momentum, self.square, self.age = (
            torch.nn.functional.pad(t, more) for t in (self.momentum, self.square, self.age)
        )

    def recolor(self, colors: Tensor) -> None:
        """Replace the colours."""
        self._hold(self.means, self.cholesky, colors)

    def is_finite(self) -> bool:
        """Say whether every number is finite, and colours far from overflow."""
        finite = torch.isfinite(self.means).all() & torch.isfinite(self.cholesky).all()
        return bool(finite & (self.colors.detach().abs() < _LARGEST_COLOR).all())

    def state(self) -> dict[str, Any]:
        """Return Gaussians and averages."""
        gaussians = dict(zip(("means", "cholesky", "colors"), (t.detach() for t in self.tensors()), strict=True))
        return {**gaussians, "momentum": self.momentum, "square": self.square, "age": self.age}

    def load(self, state: dict[str, Any]) -> None:
        """Take up Gaussians and averages."""
        self._hold(state["means"], state["cholesky"], state["colors"])
        self.momentum, self.square, self.age = state["momentum"], state["square"], state["age"]
