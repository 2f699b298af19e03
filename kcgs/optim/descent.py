"""The descent of a field by a torch optimizer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .gaussians import Gaussians, Renderer
from .objectives import Objective


@dataclass
class FieldState:
    """A field that an optimizer moves; events may replace the map, and add and remove Gaussians."""

    field: GaussianField
    optimizer: Any
    """A GaussianAdam, or an object with its `param_groups`, `step`, `append`, `keep`, `state_dict`, `load_state_dict`,
    and for a batch `freeze` and `frozen_rows`; in a fit also its `rate`, `has_drafts` and `keeps_averages`."""
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
