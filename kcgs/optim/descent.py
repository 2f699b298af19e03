"""The two descents: of a field by a torch optimizer, and of tensors by Newton's method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .gaussians import Canvas, Gaussians
from .newton import Newton, area
from .objectives import Objective


@dataclass
class FieldDescent:
    """A field that an optimizer moves; events may replace the map, and add and remove Gaussians."""

    field: GaussianField
    optimizer: Any
    """A GaussianAdam, or what has its `param_groups`, `step`, `append`, `keep`, `state_dict` and `load_state_dict`."""
    objective: Objective
    canvas: Canvas
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
        return self.canvas.regions

    @regions.setter
    def regions(self, regions: RegionMap | None) -> None:
        self.canvas = self.canvas._replace(regions=regions)

    def render(self) -> Tensor:
        """Render (C, H, W), with a graph."""
        return self.canvas.render(self.gaussians)

    def step(self, rate: float) -> None:
        """Move the field once, and count the iteration."""
        for group in self.optimizer.param_groups:
            group["lr"] = group["initial_lr"] * rate
        self.move()
        self.iteration += 1

    def move(self) -> None:
        """Take a step of the optimizer by the gradients of the objective; colours are without opacities."""
        field, rendered, self.rendered = self.field, self.rendered, None
        gradients = self.objective.gradients(self.canvas, self.gaussians, rendered)
        field.means.grad, field.cholesky.grad, field.colors.grad = gradients[:3]
        self.optimizer.step()


class NewtonDescent:
    """Gaussians that Newton steps move: unlike Adam's, they leave what is right where it is.

    Args:
        gaussians: the start.
        objective: about quadratic.
        canvas: what they are rendered with.
        exact: see :func:`kcgs.optim.frame.move`.
        min_sigma: least standard deviation of a Gaussian after a step, in pixels.
    """

    def __init__(
        self, gaussians: Gaussians, objective: Objective, canvas: Canvas, *, exact: bool = True, min_sigma: float = 0.0
    ) -> None:
        self.gaussians, self.objective, self.canvas = gaussians, objective, canvas
        self.newton = Newton(gaussians, exact=exact, min_sigma=min_sigma)
        self.iteration, self.progress = 0, 0.0
        self.frozen: Tensor | None = None  # numbers that do not move, bool, (N, 5 + C) or what broadcasts to it

    def step(self, rate: float) -> None:
        """Move the Gaussians once."""
        gradients, curvature = self.half_gradients(), self.color_curvature()
        self.gaussians = self.newton.step(self.gaussians, gradients, curvature, rate, self.frozen)
        self.iteration += 1

    def half_gradients(self) -> Gaussians:
        """Return half the gradients of the objective."""
        return self.objective.gradients(self.canvas, self.gaussians)

    def color_curvature(self) -> Tensor:
        """Return half the second derivative of the objective by a colour, (N,)."""
        return area(self.gaussians.cholesky) * self.objective.weigh(self.gaussians)
