"""A torch optimizer on the parameters of a published method."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.optim import Optimizer

from kcgs.nn import GaussianField

# pixels: thinner Gaussians fall between the pixel centres
MIN_SIGMA = 0.1


class PublishedOptimizer(ABC):
    """A torch optimizer that moves its own parameters of Gaussians, and shows them in a field.

    It has the methods of :class:`kcgs.optim.GaussianAdam` that a fit calls. A step takes the field's
    gradients back to the parameters. When Gaussians are added or removed, the averages of all start anew. Colours are
    parameters as they are, and share their memory with the field's.
    """

    def __init__(
        self,
        field: GaussianField,
        rates: Sequence[float],
        make: Callable[..., Optimizer],
        max_sigma: float = 1.0,
    ) -> None:
        height, width = field.size
        self.field, self.rates, self.make = field, rates, make
        self.limit = max_sigma * math.hypot(height, width)
        self.frozen: Tensor | None = None  # [..., N, 1]
        self.extent = field.means.detach().new_tensor([width, height])
        self._set(self.encode(field))

    @abstractmethod
    def encode(self, field: GaussianField) -> list[Tensor]:
        """Return the parameters of a field's Gaussians, (..., N, K); the colours as they are come last."""

    @abstractmethod
    def decode(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means, cholesky and colors of the parameters, with their graph."""

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """The parameter groups of the torch optimizer."""
        return self.optimizer.param_groups

    def step(self) -> None:
        """Move by the gradients of the field."""
        gradients = [tensor.grad for tensor in self._tensors()]
        if self.frozen is not None:
            gradients = [None if grad is None else grad.masked_fill(self.frozen, 0.0) for grad in gradients]
        torch.autograd.backward(self._gaussians, gradients)
        self.optimizer.step()
        self.optimizer.zero_grad()
        self._show()

    def zero_grad(self) -> None:
        """Forget the gradients of the field."""
        for tensor in self._tensors():
            tensor.grad = None

    def append(self, field: GaussianField, added: GaussianField) -> None:
        """Add the Gaussians of another field."""
        if field.region_ids is not None and added.region_ids is not None:
            field.region_ids = torch.cat([field.region_ids, added.region_ids], -1)
        if self.frozen is not None:
            self.frozen = pad(self.frozen, (0, 0, 0, added.num_gaussians))
        pairs = zip(self.parameters, self.encode(added), strict=True)
        self._set([torch.cat([old.detach(), new], -2) for old, new in pairs])

    def keep(self, field: GaussianField, mask: Tensor) -> None:
        """Remove all Gaussians but those of a mask, (..., N)."""

        def select(table: Tensor) -> Tensor:
            return table[mask].view(*mask.shape[:-1], -1, table.shape[-1])

        if field.region_ids is not None:
            field.region_ids = select(field.region_ids[..., None])[..., 0]
        if self.frozen is not None:
            self.frozen = select(self.frozen)
        self._set([select(old.detach()) for old in self.parameters])

    def freeze(self, field: GaussianField, mask: Tensor) -> None:
        """Leave Gaussians of a mask, (..., N), as they are from here on; the averages of all start anew."""
        self.frozen = mask[..., None] if self.frozen is None else self.frozen | mask[..., None]
        self._set(self.encode(field))

    def frozen_rows(self, field: GaussianField) -> Tensor:
        """Return the mask of the Gaussians that `freeze` has frozen, (..., N)."""
        none = torch.zeros_like(field.means[..., 0], dtype=torch.bool)
        return none if self.frozen is None else self.frozen[..., 0]

    def state_dict(self) -> dict[str, Any]:
        """Return parameters and averages."""
        return {"parameters": [p.detach() for p in self.parameters], "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up parameters and averages."""
        self._set(state["parameters"])
        self.optimizer.load_state_dict(state["optimizer"])

    def _set(self, parameters: list[Tensor]) -> None:
        self.parameters = [p.detach().clone().requires_grad_() for p in parameters]
        groups = [
            {"params": [p], "lr": rate, "initial_lr": rate} for p, rate in zip(self.parameters, self.rates, strict=True)
        ]
        self.optimizer = self.make(groups)
        with torch.no_grad():
            gaussians = self.decode()
        for name, value in zip(("means", "cholesky", "colors"), gaussians, strict=True):
            setattr(self.field, name, nn.Parameter(value.detach()))
        self._show()

    def _show(self) -> None:
        """Write the Gaussians into the field."""
        with torch.enable_grad():
            self._gaussians = self.decode()
        for tensor, value in zip(self._tensors(), self._gaussians, strict=True):
            tensor.data = value.detach()
            tensor.grad = None

    def _tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.field.means, self.field.cholesky, self.field.colors
