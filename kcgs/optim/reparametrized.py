"""A torch optimizer of parameters that stand for the Gaussians of a field."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.optim import Optimizer

from kcgs.errors import InvalidArgument
from kcgs.nn import GaussianField

from .rows import check_added, check_mask, rows_of, select_rows


class ReparametrizedOptimizer(ABC):
    """A torch optimizer that moves parameters of its own, and writes the Gaussians that they stand for into a field.

    Convention: a subclass has `encode`, from a field to parameters, and `decode`, from parameters to Gaussians. A step
    takes the gradients of the field back to the parameters. The last parameter is the colours, unchanged, which share
    their memory with the field's: a fit writes into them. The class has the methods of
    :class:`kcgs.optim.GaussianAdam` that a fit calls. When Gaussians are added, removed or frozen, the averages of all
    Gaussians start anew.

    Args:
        field: of an image or a batch; it gets new parameters.
        rates: the learning rate of each parameter, in the order of `encode`.
        make: makes a torch optimizer from parameter groups, such as ``torch.optim.Adam``.

    Raises:
        ValueError: a field with opacities.

    Example:
        >>> from kcgs import fit
        >>> class RoundAdam(ReparametrizedOptimizer):
        ...     "Adam on centres, log standard deviations and colours of round Gaussians."
        ...     def encode(self, field):
        ...         return [field.means, field.cholesky[..., :1].log(), field.colors]
        ...     def decode(self):
        ...         means, log_sigma, colors = self.parameters
        ...         sigma = log_sigma.exp()
        ...         return means, torch.cat([sigma, 0 * sigma, sigma], -1), colors
        >>> image = torch.linspace(0, 1, 24).expand(3, 16, 24)
        >>> optimizer = lambda field: RoundAdam(field, [0.1, 0.05, 0.02], torch.optim.Adam)
        >>> result = fit(image, num_gaussians=20, iterations=100, optimizer=optimizer)
        >>> result.psnr > 25, bool((result.scene.field.cholesky[:, 1] == 0).all())
        (True, True)
    """

    has_drafts = False
    """True: most of a fit renders with a larger cutoff."""
    keeps_averages = False
    """False: the averages start anew when Gaussians are added or removed, so no fit goes on from a finished one."""

    def __init__(
        self, field: GaussianField, rates: Sequence[float], make: Callable[[list[dict[str, Any]]], Optimizer]
    ) -> None:
        if field.opacities is not None:
            raise InvalidArgument("field", "without opacities: call field.without_opacities()", "opacities")
        self.field, self.rates, self.make = field, rates, make
        self.frozen: Tensor | None = None  # [..., N, 1]
        self._set(self.encode(field))

    @abstractmethod
    def encode(self, field: GaussianField) -> list[Tensor]:
        """Return the parameters of a field's Gaussians, each :math:`(..., N, K)`; the unchanged colours come last."""

    @abstractmethod
    def decode(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return means, cholesky and colors of `self.parameters`, with their graph."""

    def rate(self, progress: float) -> float:
        """Return the factor of the learning rates at the share of a fit that is over: always 1."""
        return 1.0

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
        self._write_to_field()

    def zero_grad(self) -> None:
        """Forget the gradients of the field."""
        for tensor in self._tensors():
            tensor.grad = None

    def append(self, field: GaussianField, added: GaussianField) -> None:
        """Add Gaussians to the optimizer's field: see :meth:`kcgs.optim.GaussianAdam.append`."""
        self._check_field(field)
        check_added(field, added)
        if field.region_ids is not None and added.region_ids is not None:
            field.region_ids = torch.cat([field.region_ids, added.region_ids], -1)
        if self.frozen is not None:
            self.frozen = pad(self.frozen, (0, 0, 0, added.num_gaussians))
        pairs = zip(self.parameters, self.encode(added), strict=True)
        self._set([torch.cat([old.detach(), new.detach()], -2) for old, new in pairs])

    def keep(self, field: GaussianField, mask: Tensor) -> None:
        """Remove all Gaussians but those of a mask: see :meth:`kcgs.optim.GaussianAdam.keep`."""
        self._check_field(field)
        index, rows = rows_of(field, mask), field.means.ndim - 2
        if field.region_ids is not None:
            field.region_ids = select_rows(field.region_ids, index, rows)
        if self.frozen is not None:
            self.frozen = select_rows(self.frozen, index, rows)
        self._set([select_rows(old.detach(), index, rows) for old in self.parameters])

    def freeze(self, field: GaussianField, mask: Tensor) -> None:
        """Leave Gaussians of a mask, :math:`(..., N)`, as they are from here on."""
        self._check_field(field)
        check_mask(mask, field.means.shape[:-1])
        self.frozen = mask[..., None] if self.frozen is None else self.frozen | mask[..., None]
        self._set(self.encode(field))

    def frozen_rows(self, field: GaussianField) -> Tensor:
        """Return the mask of the Gaussians that `freeze` has frozen, :math:`(..., N)`."""
        self._check_field(field)
        none = torch.zeros_like(field.means[..., 0], dtype=torch.bool)
        return none if self.frozen is None else self.frozen[..., 0]

    def state_dict(self) -> dict[str, Any]:
        """Return parameters, averages and the mask of the frozen Gaussians."""
        parameters = [p.detach() for p in self.parameters]
        return {"parameters": parameters, "optimizer": self.optimizer.state_dict(), "frozen": self.frozen}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take what `state_dict` returned."""
        self.frozen = state.get("frozen")  # version 0.3 froze none
        self._set(state["parameters"])
        self.optimizer.load_state_dict(state["optimizer"])

    def _check_field(self, field: GaussianField) -> None:
        if field is not self.field:
            raise InvalidArgument("field", "the one that the optimizer was made for", "another")

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
        self._write_to_field()

    def _write_to_field(self) -> None:
        """Write the Gaussians into the field."""
        with torch.enable_grad():
            self._gaussians = self.decode()
        for tensor, value in zip(self._tensors(), self._gaussians, strict=True):
            tensor.data = value.detach()
            tensor.grad = None

    def _tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.field.means, self.field.cholesky, self.field.colors
