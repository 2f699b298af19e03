"""The descent of a field by a torch optimizer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from kcgs.maps import RegionMap
from kcgs.nn import GaussianField

from .gaussians import Gaussians, Renderer
from .objectives import Objective


@runtime_checkable
class FieldOptimizer(Protocol):
    """What a fit calls of an optimizer, as :class:`GaussianAdam` has it; masks are bool, (..., N)."""

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """The groups, whose "lr" a fit sets before each step."""

    @property
    def has_drafts(self) -> bool:
        """Whether most of a fit may render with a larger cutoff."""

    @property
    def keeps_averages(self) -> bool:
        """Whether averages outlive a change of the number of Gaussians, so that a fit may go on from a finished one."""

    def rate(self, progress: float) -> float:
        """Return the factor of the initial learning rates at a share of the fit."""

    def step(self) -> Any:
        """Move the Gaussians by the gradients of the field's parameters."""

    def append(self, field: GaussianField, added: GaussianField) -> None:
        """Add the Gaussians of another field."""

    def keep(self, field: GaussianField, mask: Tensor) -> None:
        """Remove all Gaussians but those of a mask."""

    def freeze(self, field: GaussianField, mask: Tensor) -> None:
        """Leave the Gaussians of a mask as they are from here on."""

    def frozen_rows(self, field: GaussianField) -> Tensor:
        """Return the mask of the frozen Gaussians."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint stores."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take what `state_dict` returned."""


@dataclass
class FieldState:
    """A field that an optimizer moves; events may replace the map, and add and remove Gaussians."""

    field: GaussianField
    optimizer: FieldOptimizer
    objective: Objective
    renderer: Renderer
    iteration: int = 0
    progress: float = 0.0
    """Share of the descent that is over."""

    def __post_init__(self) -> None:
        for group in self.optimizer.param_groups:
            group.setdefault("initial_lr", group["lr"])

    @property
    def gaussians(self) -> Gaussians:
        """The parameters of the field."""
        return Gaussians(self.field.means, self.field.cholesky, self.field.colors, self.field.region_ids)

    @property
    def regions(self) -> RegionMap | None:
        """The map that confines the Gaussians."""
        return self.renderer.regions

    @regions.setter
    def regions(self, regions: RegionMap | None) -> None:
        self.renderer = self.renderer._replace(regions=regions)

    def render(self) -> Tensor:
        """Render (..., C, H, W), with a graph."""
        return self.renderer.render(self.gaussians)


def set_rates(state: FieldState, factor: float) -> None:
    """Set the learning rates to their initial values times a factor."""
    for group in state.optimizer.param_groups:
        group["lr"] = group["initial_lr"] * factor


def move_field(state: FieldState, rendered: Tensor | None = None) -> None:
    """Take a step of the optimizer by the gradients of the objective; the field has no opacities.

    Args:
        state: of the field.
        rendered: the field's render, with a graph, if there is one already.
    """
    field = state.field
    gradients = state.objective.gradients(state.renderer, state.gaussians, rendered)
    field.means.grad, field.cholesky.grad, field.colors.grad = gradients[:3]
    state.optimizer.step()


def step_field(state: FieldState, rate: float, rendered: Tensor | None = None) -> None:
    """Move a field once, at the initial learning rates times `rate`, and count the iteration."""
    set_rates(state, rate)
    move_field(state, rendered)
    state.iteration += 1
