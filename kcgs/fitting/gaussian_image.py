"""GaussianImage's optimizer: Adan on tanh-mapped centres, raw Cholesky factors and colours."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.optim.optimizer import Optimizer, ParamsT

from kcgs.nn import GaussianField
from kcgs.optim import ReparametrizedOptimizer

# largest argument of atanh, which is infinite at 1
_EDGE = 1.0 - 1e-6
# least standard deviation, in pixels: thinner Gaussians fall between the pixel centres
_MIN_SIGMA = 0.1


class GaussianImageAdan(ReparametrizedOptimizer):
    """Adan on centres through tanh, and on Cholesky factors and colours as they are.

    The learning rate of 1e-3 is for 50,000 iterations. A shorter fit multiplies it by the square root of the ratio of
    iterations, at most by 20. Steps of the factors scale with `sigma`, the size of the Gaussians at the start. A
    factor's columns may change sign in the descent; the covariance stays the same.

    Source: Zhang et al., "GaussianImage: 1000 FPS Image Representation and Compression by 2D Gaussian Splatting", 2024.
    """

    learning_rate = 1e-3
    full_iterations = 50_000
    max_rate_factor = 20.0
    half_life = 0.4
    """Share of a fit between two halvings of the rates."""
    max_sigma = 10.0
    """Largest standard deviation of a Gaussian, in image diagonals."""

    def __init__(self, field: GaussianField, sigma: float, iterations: int, rate_factor: float) -> None:
        speedup = min(self.max_rate_factor, math.sqrt(max(1.0, self.full_iterations / iterations)))
        rate = self.learning_rate * speedup * rate_factor
        height, width = field.size
        self.extent = field.means.detach().new_tensor([width, height])
        self.limit = self.max_sigma * math.hypot(height, width)
        super().__init__(field, [rate, rate * sigma, rate], Adan)

    def rate(self, progress: float) -> float:
        """Return the factor of the learning rates."""
        return 0.5 ** int(progress / self.half_life)

    def encode(self, field: GaussianField) -> list[Tensor]:
        """Return the centres before tanh, factors and colours."""
        means, cholesky, colors = field.means.detach(), field.cholesky.detach(), field.merged_colors().detach()
        centres = (2 * means / self.extent - 1).clamp(-_EDGE, _EDGE)
        # image by image: the last bit of torch's atanh depends on a number's place in memory
        parts = [torch.atanh(image) for image in centres.view(-1, *centres.shape[-2:])]
        return [torch.stack(parts).view_as(centres), cholesky, colors]

    def decode(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means, Cholesky factors with a positive diagonal, and colours."""
        centres, factors, colors = self.parameters
        means = 0.5 * (torch.tanh(centres) + 1) * self.extent
        l11, l21, l22 = factors.unbind(-1)
        cholesky = torch.stack(
            [
                l11.abs().clamp(_MIN_SIGMA, self.limit),
                torch.where(l11 < 0, -l21, l21).clamp(-self.limit, self.limit),
                l22.abs().clamp(_MIN_SIGMA, self.limit),
            ],
            -1,
        )
        return means, cholesky, colors


class Adan(Optimizer):
    """Adaptive Nesterov momentum: averages of the gradient, of its change, and of the squared look-ahead.

    As in the authors' release, the betas are the weights of the past (the paper's betas are 1 minus these). The
    averages start at zero, with a correction for this. At the first step the change of the gradient is zero.

    Source: Xie et al., "Adan: Adaptive Nesterov Momentum Algorithm", 2022, Algorithm 1 without its restarts.
    """

    def __init__(
        self,
        params: ParamsT,
        lr: float = 1e-3,
        betas: tuple[float, float, float] = (0.98, 0.92, 0.99),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move every parameter that has a gradient."""
        assert closure is None
        for group in self.param_groups:
            for parameter in (p for p in group["params"] if p.grad is not None):
                _update(parameter, parameter.grad, self.state[parameter], group)


def _update(parameter: Tensor, gradient: Tensor, state: dict[str, Any], group: dict[str, Any]) -> None:
    if not state:
        state.update({name: torch.zeros_like(parameter) for name in ("momentum", "change", "square")})
        state.update(step=0, previous=gradient.clone())
    state["step"] += 1
    beta1, beta2, beta3 = group["betas"]
    correction1, correction2, correction3 = (1.0 - beta ** state["step"] for beta in group["betas"])

    change = gradient - state["previous"]
    state["previous"].copy_(gradient)
    state["momentum"].lerp_(gradient, 1.0 - beta1)
    state["change"].lerp_(change, 1.0 - beta2)
    look_ahead = change.mul_(beta2).add_(gradient)
    state["square"].mul_(beta3).addcmul_(look_ahead, look_ahead, value=1.0 - beta3)

    scale = state["square"].sqrt().div_(math.sqrt(correction3)).add_(group["eps"])
    parameter.addcdiv_(state["momentum"], scale, value=-group["lr"] / correction1)
    parameter.addcdiv_(state["change"], scale, value=-group["lr"] * beta2 / correction2)
