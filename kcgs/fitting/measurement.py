"""The errors of a render."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from kcgs.scene import Scene

from .problem import Problem
from .state import FitState, Measurement


def snapshot(state: FitState, seconds: float) -> Measurement:
    """Copy the scene of a state, so many seconds after the start of the fit."""
    scene = Scene(copy.deepcopy(state.field), state.regions)
    return Measurement(state.iteration, seconds, scene, state.is_draft)


def measure_errors(problem: Problem, rendered: Tensor) -> Tensor:
    """Return the errors of a render, see `Errors`, (3,) or for a batch (B, 3), on its device and without a host sync.

    Args:
        problem: of the image, (C, H, W), or of a batch of them.
        rendered: of the same shape.
    """
    objective, image, rendered = problem.objective, problem.image, rendered.detach()
    if image is not None and image.is_cpu:
        from .measurement_loops import mean_errors  # loads numba

        render_array, image_array = (tensor.reshape(-1, *tensor.shape[-3:]).numpy() for tensor in (rendered, image))
        means = mean_errors(render_array, image_array, problem.band.numpy(), is_squared=objective.power != 1)
        errors = torch.from_numpy(means).reshape(*rendered.shape[:-3], 3)
        if objective.power is None:
            errors[..., 0] = objective.value(rendered)
        return errors
    value = objective.value(rendered)
    error = band_error = torch.full_like(value, torch.nan)
    if image is not None:
        square = (rendered.clamp(0.0, 1.0) - image).square()
        error = square.mean((-3, -2, -1)).to(value)
        if (near := problem.band_mask) is not None:
            count = near.sum((-3, -2, -1)) * square.shape[-3]
            band_error = ((square * near).sum((-3, -2, -1)) / count).to(value)
    return torch.stack([value, error, band_error], -1)
