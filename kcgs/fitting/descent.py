"""What the loop and the strategies do with a scene: render it, and take the gradient of the loss."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcgs.functional import RegionMap, region_splat, ssim
from kcgs.functional.splat import squared_error_gradients
from kcgs.nn import GaussianField
from kcgs.scene import Scene

from .problem import Problem
from .readback import Readback
from .state import FitState

# weight of 1 - SSIM beside the mean absolute error, as in Image-GS
_SSIM_WEIGHT = 0.1
# Cutoff of descents whose result is rendered with a smaller one: it saves a third of the weights of 1e-4.
DRAFT_CUTOFF = 1e-3
# numbers beyond it are near overflow
_LARGEST = 1e15
# where the host runs ahead of a device; more of them let it run farther
_ITERATIONS_PER_CHECK = 10


def render(state: FitState, scene: Scene | None = None) -> Tensor:
    """Render (C, H, W): the state's scene, or another."""
    scene, config = scene or state.scene, state.problem.config
    field, size = scene.field, state.problem.size
    rendered = region_splat(
        field.means, field.cholesky, field.colors, field.region_ids, scene.regions,
        size=size, cutoff=state.cutoff, backend=config.backend,
    )  # fmt: skip
    bounds = state.problem.bounds
    return rendered if bounds is None else rendered.clamp(*bounds)


def squared_error(state: FitState, regions: RegionMap | None = None) -> Tensor:
    """Squared error of each pixel, (H, W), channels averaged; with other contours, where `regions` are given."""
    scene = state.scene if regions is None else Scene(state.scene.field, regions)
    return (render(state, scene).detach() - state.problem.image).square().mean(0)


def backward(state: FitState, rendered: Tensor | None) -> None:
    """Leave half the gradient of the loss at the field; no optimizer here depends on the factor.

    Without a render, (C, H, W), the scene is rendered and differentiated in one pass, if the loss is the squared error
    of the render as it is.
    """
    problem, field = state.problem, state.scene.field
    config, image = problem.config, problem.image
    state.optimizer.zero_grad()
    if rendered is None and takes_one_pass(problem):
        field.means.grad, field.cholesky.grad, field.colors.grad = squared_error_gradients(
            image, field.means, field.cholesky, field.colors, field.region_ids, state.scene.regions,
            cutoff=state.cutoff, backend=config.backend,
        )  # fmt: skip
        return
    rendered = render(state) if rendered is None else rendered
    if config.loss == "l2":
        # in the memory of the render, which nothing needs again: new memory would take as long as the sum
        difference = rendered.data.sub_(image)
        rendered.backward(difference if problem.objective is None else problem.objective.apply(difference))
        return
    sign = torch.sub(rendered.detach(), image).sign_()
    if config.loss == "l1+ssim":
        leaf = rendered.detach().requires_grad_()
        (slope,) = torch.autograd.grad(ssim(leaf, image), leaf)
        sign -= _SSIM_WEIGHT * leaf.numel() * slope
    rendered.backward(sign)


def takes_one_pass(problem: Problem) -> bool:
    """True where the loss is the squared error of the render as it is."""
    return problem.config.loss == "l2" and problem.objective is None and problem.bounds is None


def has_diverged(state: FitState) -> bool:
    """True where a number is not finite, or near overflow; where the host runs ahead, some iterations ago.

    There it waits, every ten iterations, for what the device did ten iterations before: so it is never twenty ahead.
    Where a step had gradients of NaN, since its lists did not fit, the next one waits, to learn how much they take.
    """
    field = state.scene.field
    if not state.runs_ahead:
        return not is_finite(field)
    if state.iteration % _ITERATIONS_PER_CHECK:
        return False
    tables = field.means, field.cholesky, field.colors
    gradients = [table.grad for table in tables if table.grad is not None]
    previous, state.magnitudes = state.magnitudes, Readback(_magnitudes([*tables, *gradients]))
    if previous is None:
        return False
    numbers, columns = previous.numbers(), sum(table.shape[1] for table in tables)
    if any(map(math.isnan, numbers[columns:])):
        state.waits = True
    return not all(number < _LARGEST for number in numbers[:columns])


def is_finite(field: GaussianField) -> bool:
    """True where every number is finite, and far from overflow."""
    tables = field.means, field.cholesky, field.colors
    if not field.means.is_cpu:
        return bool((_magnitudes(tables) < _LARGEST).all())
    from kcgs.optim.loops import is_within  # loads numba

    # compiled: between renders, whose data fill the caches, an operation of torch takes thirty microseconds
    return all(is_within(table.detach().numpy().ravel(), _LARGEST) for table in tables)


@torch.no_grad()
def _magnitudes(tables: Sequence[Tensor]) -> Tensor:
    """Return the largest absolute number of each column of tables, (N, K) each; a NaN is the largest."""
    return torch.cat([*tables], -1).abs().amax(0)
