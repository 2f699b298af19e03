"""Conjugate gradients, as the colours of Gaussians are solved for."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def conjugate_gradients(
    x: Tensor,
    r: Tensor,
    apply: Callable[[Tensor], Tensor],
    steps: int,
    *,
    dot: Callable[[Tensor, Tensor], Tensor],
    gradient: Callable[[Tensor], Tensor] | None = None,
    least_squares: bool = False,
) -> Tensor:
    """Take steps from x towards the solution of A x = b, where r = b - A x and `apply` is p to A p.

    `gradient` takes r to the direction of descent: a preconditioner; with `least_squares`, where A is rectangular and
    abs(b - A x)^2 is to be least, the product with the transpose. `dot` gives a tensor where columns are problems of
    their own. Source: Hestenes and Stiefel, "Methods of conjugate gradients for solving linear systems", 1952.
    """
    z = r if gradient is None else gradient(r)
    p, power = z, dot(z, z if least_squares else r)
    for _ in range(steps):
        Ap = apply(p)
        alpha = _ratio(power, dot(Ap, Ap if least_squares else p)).to(x.dtype)
        x, r = x + alpha * p, r - alpha * Ap
        z = r if gradient is None else gradient(r)
        last, power = power, dot(z, z if least_squares else r)
        beta = _ratio(power, last).to(x.dtype)
        p = z + beta * p
    return x


def _ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    return torch.where(denominator > 0, numerator / denominator, 0.0)
