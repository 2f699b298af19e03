"""The errors of a render."""

from __future__ import annotations

import copy

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from kcgs.scene import Scene

from .problem import Problem
from .state import FitState, Measurement


def snapshot(state: FitState, seconds: float) -> Measurement:
    """Copy the scene of a state, so many seconds after the start of the fit."""
    scene = Scene(copy.deepcopy(state.field), state.regions)
    return Measurement(state.iteration, seconds, scene, state.is_draft)


def measure_errors(problem: Problem, rendered: Tensor) -> Tensor:
    """Return the errors of a render, (C, H, W), see `Errors`, (3,), on its device and without waiting for it."""
    objective, image, rendered = problem.objective, problem.image, rendered.detach()
    if image is not None and image.is_cpu:
        from .measurement_loops import mean_errors  # loads numba

        arrays = [tensor.numpy() for tensor in (rendered, image, problem.band)]
        means = [*mean_errors(*arrays, is_squared=objective.power != 1)]
        if objective.power is None:
            means[0] = float(objective.value(rendered))
        return torch.tensor(means, dtype=torch.float64)
    value = objective.value(rendered)
    error = band_error = value.new_full((), torch.nan)
    if image is not None:
        clipped = rendered.clamp(0.0, 1.0)
        error = mse_loss(clipped, image).to(value)
        if len(problem.band):
            y, x = problem.band.unbind(1)
            band_error = mse_loss(clipped[:, y, x], image[:, y, x]).to(value)
    return torch.stack([value, error, band_error])
