"""The Adan optimiser, which GaussianImage uses."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.optim.optimizer import Optimizer, ParamsT


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
