"""The Adan optimiser, which GaussianImage uses."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.optim.optimizer import Optimizer, ParamsT


class Adan(Optimizer):
    r"""Adaptive Nesterov momentum: averages of the gradient, of its change, and of the squared look-ahead.

    Convention: as in the authors' release the betas weigh the past (the paper writes one minus them), the
    averages start at zero and are corrected for it, and the gradient before the first is the first. Weight
    decay is proximal: a division by 1 + lr * weight_decay. State: `step`; `momentum`, `change`, `square`,
    `previous`.

    Args:
        params: parameters, or dicts of parameter groups.
        lr: step size, at least 0.
        betas: decay of the averages of gradient, change and square, each in [0, 1).
        eps: added to the root of the square, at least 0.
        weight_decay: at least 0.

    Raises:
        ValueError: a number out of range, here or in a group.

    Example:
        >>> point = torch.nn.Parameter(torch.tensor([1.0, -2.0]))
        >>> point.square().sum().backward()
        >>> Adan([point], lr=0.1).step()
        >>> point.data
        tensor([ 0.9000, -1.9000])

    Source: Xie et al., "Adan: Adaptive Nesterov Momentum Algorithm", 2022, Algorithm 1 without its restarts.
    """

    def __init__(
        self,
        params: ParamsT,
        lr: float = 1e-3,
        betas: tuple[float, float, float] = (0.98, 0.92, 0.99),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps, "weight_decay": weight_decay})

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add parameters with hyper-parameters of their own; those not named are the optimiser's."""
        group = {**self.defaults, **param_group}
        for name in ("lr", "eps", "weight_decay"):
            if not 0.0 <= group[name] < math.inf:
                raise ValueError(f"{name} must be finite and at least 0; got {group[name]!r}")
        if len(group["betas"]) != 3 or not all(0.0 <= beta < 1.0 for beta in group["betas"]):
            raise ValueError(f"betas must be three numbers in [0, 1); got {group['betas']!r}")
        super().add_param_group(param_group)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Move every parameter that has a gradient; return the loss of `closure`, which evaluates it anew."""
        with torch.enable_grad():
            loss = None if closure is None else closure()
        for group in self.param_groups:
            for parameter in (p for p in group["params"] if p.grad is not None):
                _update(parameter, parameter.grad, self.state[parameter], group)
        return loss


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
    ahead = change.mul_(beta2).add_(gradient)
    state["square"].mul_(beta3).addcmul_(ahead, ahead, value=1.0 - beta3)

    scale = state["square"].sqrt().div_(math.sqrt(correction3)).add_(group["eps"])
    parameter.addcdiv_(state["momentum"], scale, value=-group["lr"] / correction1)
    parameter.addcdiv_(state["change"], scale, value=-group["lr"] * beta2 / correction2)
    parameter.div_(1.0 + group["lr"] * group["weight_decay"])
