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
class FieldDescent:
    """A field that an optimizer moves; events may replace the map, and add and remove Gaussians."""

    field: GaussianField
    optimizer: Any
    """A GaussianAdam, or what has its `param_groups`, `step`, `append`, `keep`, `state_dict` and `load_state_dict`."""
    objective: Objective
    renderer: Renderer
    iteration: int = 0
    progress: float = 0.0
    rendered: Tensor | None = None
    """The render before the next step, with its graph, where an event has left it."""

    def __post_init__(self) -> None:
        for group in self.optimizer.param_groups:
            group.setdefault("initial_lr", group["lr"])

    @property
    def gaussians(self) -> Gaussians:
        """The parameters of the field."""
        return Gaussians(self.field.means, self.field.cholesky, self.field.colors, self.field.region_ids)

    @property
    def regions(self) -> RegionMap | None:
        """The map that Gaussians are confined by."""
        return self.renderer.regions

    @regions.setter
    def regions(self, regions: RegionMap | None) -> None:
        self.renderer = self.renderer._replace(regions=regions)

    def render(self) -> Tensor:
        """Render (C, H, W), with a graph."""
        return self.renderer.render(self.gaussians)

    def step(self, rate: float) -> None:
        """Move the field once, and count the iteration."""
        for group in self.optimizer.param_groups:
            group["lr"] = group["initial_lr"] * rate
        self.move()
        self.iteration += 1

    def move(self) -> None:
        """Take a step of the optimizer by the gradients of the objective; colours are without opacities."""
        field, rendered, self.rendered = self.field, self.rendered, None
        gradients = self.objective.gradients(self.renderer, self.gaussians, rendered)
        field.means.grad, field.cholesky.grad, field.colors.grad = gradients[:3]
        self.optimizer.step()
