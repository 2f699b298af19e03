"""Newton's method for every number of a Gaussian alone, where the second derivatives of the error are known."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .frame import local_gradient, move, widen
from .gaussians import Gaussians, Renderer
from .objectives import Objective

# half the second derivatives of the squared error by a step in a Gaussian's frame, per energy of the Gaussian, its
# integral of the square: two of the centre, three of the factor. With w the Gaussian and (u, v) whitened coordinates,
# the mean of (u w)^2 per w^2 is 1/2, of (u^2 w)^2 is 3/4, of (u v w)^2 is 1/4
_CURVATURE = (0.5, 0.5, 0.75, 0.25, 0.75)
# least energy of a Gaussian in a step: with less, the error would have next to no curvature
_MIN_ENERGY = 1e-2
# pixels: on pixel centres a narrower Gaussian weighs as if it had this standard deviation
_MIN_SIGMA = 0.56
# the largest Newton step, in standard deviations and in log scale: farther away the error is not quadratic
_MAX_NEWTON_STEP = 0.3
# the largest step with momentum, in the same units
_MAX_STEP = 0.2
# share of the last step that is added to a step
_MOMENTUM = 0.9


class NewtonDescent:
    """Newton steps of every number by itself, in each Gaussian's frame, with momentum.

    A number with a small gradient hardly moves, while Adam moves all numbers about as far.

    Args:
        gaussians: the start.
        objective: about quadratic.
        renderer: of these Gaussians.
        exact: see :func:`kcgs.optim.frame.move`.
        min_sigma: least standard deviation of a Gaussian after a step, in pixels.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        objective: Objective,
        renderer: Renderer,
        *,
        exact: bool = True,
        min_sigma: float = 0.0,
    ) -> None:
        self.gaussians, self.objective, self.renderer = gaussians, objective, renderer
        self.exact, self.min_sigma = exact, min_sigma
        self.velocity = torch.zeros_like(torch.cat(gaussians[:3], -1))  # [N, 5 + C]
        self.frozen: Tensor | None = None  # numbers that do not move, bool, (N, 5 + C) or broadcast to it
        self.iteration, self.progress = 0, 0.0

    def step(self, rate: float) -> None:
        """Move the Gaussians once, by a share of a Newton step."""
        self.velocity = _MOMENTUM * self.velocity + self._newton_step()
        if self.frozen is not None:
            self.velocity = torch.where(self.frozen, 0.0, self.velocity)
        means, cholesky, colors, region_ids = self.gaussians
        step = rate * self.velocity
        means, cholesky = move(means, cholesky, step[:, :5].clamp(-_MAX_STEP, _MAX_STEP), exact=self.exact)
        if self.min_sigma > 0.0:
            cholesky = widen(cholesky, self.min_sigma)
        self.gaussians = Gaussians(means, cholesky, colors + step[:, 5:], region_ids)
        self.iteration += 1

    def half_gradients(self) -> Gaussians:
        """Return half the gradients of the objective."""
        return self.objective.gradients(self.renderer, self.gaussians)

    def color_curvature(self) -> Tensor:
        """Return half the second derivative of the objective by a colour, (N,)."""
        return self_product(self.gaussians.cholesky) * self.objective.weigh(self.gaussians)

    def _newton_step(self) -> Tensor:
        """Return Newton's steps of centre, factor and colours, (N, 5 + C)."""
        gradients, curvature = self.half_gradients(), self.color_curvature()
        energy = (self.gaussians.colors.square().sum(-1) * curvature).clamp_min(_MIN_ENERGY)
        local = local_gradient(self.gaussians.cholesky, gradients.means, gradients.cholesky)
        geometry = local / (energy[:, None] * energy.new_tensor(_CURVATURE))
        geometry = geometry.clamp(-_MAX_NEWTON_STEP, _MAX_NEWTON_STEP)
        return -torch.cat([geometry, gradients.colors / curvature[:, None]], -1)


def self_product(cholesky: Tensor) -> Tensor:
    """Return the sum of each Gaussian's squared weights over pixel centres, (..., N)."""
    return math.pi * cholesky[..., ::2].clamp_min(_MIN_SIGMA).prod(-1)
