"""The errors of renders."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from kcgs.scene import Scene

from .problem import Problem
from .state import Errors, FitState, Measurement


def snapshot(state: FitState, seconds: float) -> Measurement:
    """Copy the scene of a state, `seconds` after the start of the fit."""
    scene = Scene(copy.deepcopy(state.field), state.regions)
    return Measurement(state.iteration, seconds, scene, state.is_draft, [*state.diverged])


def measure_errors(problem: Problem, rendered: Tensor) -> Errors:
    """Return the errors of a render, (B, C, H, W), on its device and without a host sync."""
    objective, image, rendered = problem.objective, problem.image, rendered.detach()
    if image is not None and image.is_cpu:
        from .measurement_loops import mean_errors  # loads numba

        means = mean_errors(rendered.numpy(), image.numpy(), problem.band.numpy(), is_squared=objective.power != 1)
        errors = Errors(*torch.from_numpy(means).unbind(1))
        return errors if objective.power is not None else errors._replace(objective=objective.value(rendered))
    value = objective.value(rendered)
    error = band_error = torch.full_like(value, torch.nan)
    if image is not None:
        square = (rendered.clamp(0.0, 1.0) - image).square()
        error = square.mean((1, 2, 3)).to(value)
        if (near := problem.band_mask) is not None:
            count = near.sum((-3, -2, -1)) * square.shape[1]
            band_error = ((square * near).sum((1, 2, 3)) / count).to(value)
    return Errors(value, error, band_error)
