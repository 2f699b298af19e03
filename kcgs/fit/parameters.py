"""What the optimiser moves, and how it becomes Gaussians: the parametrisation of GaussianImage."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from kcgs.nn import GaussianField

# thinner than this, a Gaussian falls between the pixel centres
_LEAST_SIGMA = 0.1
# wider than this many image diagonals, it is a constant
_MOST_DIAGONALS = 10.0
_EDGE = 1.0 - 1e-6
_LARGEST_COLOR = 1e15


class RawParameters:
    """Centres through tanh, Cholesky factors and colours as they are.

    A factor's columns may change sign in the descent, which leaves the covariance as it is; `tensors` returns the
    factor with a positive diagonal.
    """

    def __init__(self, field: GaussianField) -> None:
        height, width = field.size
        self.limit = _MOST_DIAGONALS * math.hypot(height, width)
        self.extent = field.means.new_tensor([width, height])
        scaled = (2 * field.means.detach() / self.extent - 1).clamp(-_EDGE, _EDGE)
        self.centres = torch.atanh(scaled).requires_grad_()
        self.factors = field.cholesky.detach().clone().requires_grad_()
        self.colors = field.merged_colors().detach().clone().requires_grad_()

    def groups(self, learning_rate: float, sigma: float) -> list[dict[str, Any]]:
        """Return optimiser groups; steps of the factors scale with the size of the Gaussians at the start."""
        return [
            {"params": [self.centres], "lr": learning_rate},
            {"params": [self.factors], "lr": learning_rate * sigma},
            {"params": [self.colors], "lr": learning_rate},
        ]

    def is_finite(self) -> bool:
        """Say whether every number is finite, and colours far from overflow."""
        return bool(
            torch.isfinite(self.centres).all()
            & torch.isfinite(self.factors).all()
            & (self.colors.detach().abs() < _LARGEST_COLOR).all()
        )

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means (N, 2), cholesky (N, 3) with positive diagonal, colours (N, C)."""
        means = 0.5 * (torch.tanh(self.centres) + 1) * self.extent
        l11, l21, l22 = self.factors.unbind(-1)
        cholesky = torch.stack(
            [
                l11.abs().clamp(_LEAST_SIGMA, self.limit),
                torch.where(l11 < 0, -l21, l21).clamp(-self.limit, self.limit),
                l22.abs().clamp(_LEAST_SIGMA, self.limit),
            ],
            -1,
        )
        return means, cholesky, self.colors

    def state(self) -> dict[str, Tensor]:
        """Return the numbers that the optimiser moves."""
        return {name: getattr(self, name).detach() for name in ("centres", "factors", "colors")}

    @torch.no_grad()
    def load(self, state: dict[str, Tensor]) -> None:
        """Take up numbers, in place, since the optimiser holds these tensors."""
        for name, value in state.items():
            getattr(self, name).copy_(value)
