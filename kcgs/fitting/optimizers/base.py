"""What an optimizer of Gaussians offers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor

from kcgs.nn import GaussianField

# colours beyond it are near overflow
_LARGEST_COLOR = 1e15
# thinner than this, in pixels, a Gaussian falls between the pixel centres
LEAST_SIGMA = 0.1


class GaussianOptimizer(ABC):
    """Gaussians that can be rendered, differentiated, and moved downhill.

    What moves is `raw`, tensors of which the last holds the colours as they are.
    """

    widest = 1.0
    """The widest a Gaussian may be, in image diagonals: such a one is a constant."""
    raw: list[Tensor]

    def __init__(self, field: GaussianField) -> None:
        height, width = field.size
        self.limit = self.widest * math.hypot(height, width)
        self.extent = field.means.new_tensor([width, height])
        gaussians = field.means.detach(), field.cholesky.detach(), field.merged_colors().detach()
        self.set_raw([t.clone() for t in self.encode(*gaussians)])

    def set_raw(self, raw: list[Tensor]) -> None:
        """Take these for the raw tensors."""
        self.raw = [t.detach().requires_grad_() for t in raw]

    @abstractmethod
    def encode(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> list[Tensor]:
        """Return the raw tensors of Gaussians."""

    @abstractmethod
    def gaussians(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means (N, 2), cholesky (N, 3), colors (N, C), which carry the graph."""

    @abstractmethod
    def decay(self, progress: float) -> float:
        """Return the factor on the learning rates when this share of the fit is done."""

    @abstractmethod
    def step(self, factor: float) -> None:
        """Move by the gradients of the last backward, at `factor` times the learning rates, and forget them."""

    def append(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> None:
        """Add Gaussians."""
        added = self.encode(means, cholesky, colors)
        self.set_raw([torch.cat([old.detach(), new]) for old, new in zip(self.raw, added, strict=True)])

    def keep(self, mask: Tensor) -> None:
        """Leave out the others."""
        self.set_raw([t.detach()[mask] for t in self.raw])

    def recolor(self, colors: Tensor) -> None:
        """Replace the colours."""
        with torch.no_grad():
            self.raw[-1].copy_(colors)

    def is_finite(self) -> bool:
        """Say whether every number is finite, and colours far from overflow."""
        finite = [torch.isfinite(t).all() for t in self.raw[:-1]]
        return bool(torch.stack([*finite, (self.raw[-1].detach().abs() < _LARGEST_COLOR).all()]).all())

    def state_dict(self) -> dict[str, Any]:
        """Return everything a resumed fit needs, as tensors and numbers."""
        return {"raw": [t.detach() for t in self.raw]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a state."""
        self.set_raw(state["raw"])


class PublishedOptimizer(GaussianOptimizer):
    """A torch optimizer on the raw parameters of a published method."""

    rates: list[float]
    """Learning rate of each raw tensor."""
    make: type[Any]
    """The torch optimizer."""

    def set_raw(self, raw: list[Tensor]) -> None:
        """Take these for the raw tensors; the averages of all start anew."""
        super().set_raw(raw)
        self.optimizer = self.make([{"params": [t], "lr": rate} for t, rate in zip(self.raw, self.rates, strict=True)])

    def step(self, factor: float) -> None:
        """Move and forget the gradients."""
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Any]:
        """Return raw tensors and averages."""
        return {**super().state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up raw tensors and averages."""
        super().load_state_dict(state)
        self.optimizer.load_state_dict(state["optimizer"])
