"""Newton's method for every number of a Gaussian alone, where the second derivatives of the error are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from .frame import area, move, newton_steps

__all__ = ["Gaussians", "NewtonDescent", "Objective", "area", "half_gradients"]

# share of the last step that is added to a step
_MOMENTUM = 0.9
# the largest step, in standard deviations and in log scale: derivatives are those at its start
_MAX_STEP = 0.2


class Gaussians(NamedTuple):
    """The parameters that a descent moves, or something for each of them."""

    means: Tensor  # [N, 2]
    cholesky: Tensor  # [N, 3]
    colors: Tensor  # [N, C]


class Objective(Protocol):
    """An error of a render that is about quadratic."""

    def apply(self, residual: Tensor) -> Tensor:
        """Return half the gradient at a residual, render - image, (C, H, W)."""

    def weigh(self, means: Tensor, cholesky: Tensor) -> Tensor:
        """Return what the squared error of each Gaussian weighs in the objective, (N,)."""


class NewtonDescent:
    """Newton steps of every number alone, in each Gaussian's frame, with momentum.

    A number with a small gradient hardly moves; Adam, whose steps are as long for small gradients as for large ones,
    moves it as far as any other.

    Args:
        gaussians: the start, for its shapes.
        exact: see :func:`kcgs.optim.frame.move`.
    """

    def __init__(self, gaussians: Gaussians, *, exact: bool = True) -> None:
        self.velocity = torch.zeros_like(torch.cat(gaussians, -1))  # [N, 5 + C]
        self.exact = exact

    def step(
        self, gaussians: Gaussians, gradients: Gaussians, masses: Tensor, rate: float, frozen: Tensor | None = None
    ) -> Gaussians:
        """Return the Gaussians after a step.

        Args:
            gaussians: before the step.
            gradients: half the gradients of the error.
            masses: second derivative of the error by a colour, halved, (N,).
            rate: share of a Newton step.
            frozen: numbers that stay, bool, (N, 5 + C) or what broadcasts to it.
        """
        means, cholesky, colors = gaussians
        self.velocity = _MOMENTUM * self.velocity + newton_steps(cholesky, colors, gradients, masses)
        if frozen is not None:
            self.velocity = torch.where(frozen, 0.0, self.velocity)
        step = rate * self.velocity
        means, cholesky = move(means, cholesky, step[:, :5].clamp(-_MAX_STEP, _MAX_STEP), exact=self.exact)
        return Gaussians(means, cholesky, colors + step[:, 5:])


def half_gradients(
    render: Callable[[Tensor, Tensor, Tensor], Tensor], gaussians: Gaussians, image: Tensor, objective: Objective | None
) -> Gaussians:
    """Return half the gradients of the error of a render, (C, H, W); without an objective, of the squared error."""
    leaves = [t.detach().requires_grad_() for t in gaussians]
    with torch.enable_grad():
        rendered = render(*leaves)
    residual = rendered.detach() - image
    if objective is not None:
        residual = objective.apply(residual)
    return Gaussians(*torch.autograd.grad(rendered, leaves, residual))
