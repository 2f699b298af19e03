"""What an optimizer of Gaussians offers, and the torch optimizers of published methods."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Protocol

import torch
from torch import Tensor

from kcgs.nn import GaussianField

# colours beyond it are near overflow
LARGEST_COLOR = 1e15
# thinner than this, in pixels, a Gaussian falls between the pixel centres
LEAST_SIGMA = 0.1


class GaussianOptimizer(Protocol):
    """Gaussians that can be rendered, differentiated, and moved downhill."""

    def gaussians(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means (N, 2), cholesky (N, 3), colors (N, C), which carry the graph."""

    def decay(self, progress: float) -> float:
        """Return the factor on the learning rates when this share of the fit is done."""

    def step(self, factor: float) -> None:
        """Move by the gradients of the last backward, at `factor` times the learning rates, and forget them."""

    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Add Gaussians."""

    def recolor(self, colors: Tensor) -> None:
        """Replace the colours."""

    def is_finite(self) -> bool:
        """Say whether every number is finite, and colours far from overflow."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything a resumed fit needs, as tensors and numbers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a state."""


class PublishedOptimizer(ABC):
    """A torch optimizer on the raw parameters of a published method; colours are the last of them, as they are."""

    rates: list[float]
    """Learning rate of each raw parameter."""
    widest: float
    """The widest a Gaussian may be, in image diagonals."""

    def __init__(self, field: GaussianField) -> None:
        height, width = field.size
        self.limit = self.widest * math.hypot(height, width)
        self.extent = field.means.new_tensor([width, height])
        gaussians = field.means.detach(), field.cholesky.detach(), field.merged_colors().detach()
        self._begin([t.clone() for t in self.encode(*gaussians)])

    def _begin(self, raw: list[Tensor]) -> None:
        self.raw = [t.requires_grad_() for t in raw]
        groups = [{"params": [t], "lr": rate} for t, rate in zip(self.raw, self.rates, strict=True)]
        self.optimizer = self.make(groups)

    @abstractmethod
    def make(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Make the torch optimizer."""

    @abstractmethod
    def encode(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> list[Tensor]:
        """Return the raw parameters of Gaussians."""

    @abstractmethod
    def gaussians(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the Gaussians."""

    def step(self, factor: float) -> None:
        """Move and forget the gradients."""
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Add Gaussians; the averages of all start anew."""
        added = self.encode(means, cholesky, colors)
        self._begin([torch.cat([old.detach(), new]) for old, new in zip(self.raw, added, strict=True)])

    def recolor(self, colors: Tensor) -> None:
        """Replace the colours."""
        with torch.no_grad():
            self.raw[-1].copy_(colors)

    def is_finite(self) -> bool:
        """Say whether every number is finite, and colours far from overflow."""
        finite = [torch.isfinite(t).all() for t in self.raw[:-1]]
        return bool(torch.stack([*finite, (self.raw[-1].detach().abs() < LARGEST_COLOR).all()]).all())

    def state_dict(self) -> dict[str, Any]:
        """Return raw parameters and averages."""
        return {"raw": [t.detach() for t in self.raw], "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up raw parameters and averages."""
        self._begin(state["raw"])
        self.optimizer.load_state_dict(state["optimizer"])
