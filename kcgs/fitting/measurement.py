"""Measurements of a fit: its time, the errors of its renders, the history, and the best scene of each image."""

from __future__ import annotations

import copy
import time
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.errors import InvalidArgument
from kcgs.scene import Scene

from .best import Best
from .problem import Problem
from .result import HistoryEntry
from .state import FitState


class Clock:
    """Wall time of a fit, in seconds; a resumed fit starts at the seconds that it has already used."""

    def __init__(self, seconds: float = 0.0) -> None:
        self._started = time.perf_counter() - seconds

    def seconds(self) -> float:
        """Seconds that the fit has used."""
        return time.perf_counter() - self._started


class Measurement(NamedTuple):
    """The scenes of a render, and when they were rendered."""

    iteration: int
    seconds: float
    scene: Scene  # a copy, since the fit goes on
    is_draft: bool
    excluded: list[int]  # images that had diverged


class Errors(NamedTuple):
    """Mean errors of the render of each image, (B,)."""

    objective: Tensor
    squared: Tensor  # of the render clipped to [0, 1]; NaN without an image
    squared_near_contours: Tensor  # the same over the band of EF-PSNR; NaN without contours


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


def record(state: FitState, measurement: Measurement, errors: Errors) -> None:
    """Append a measurement to the history, and keep the best scene of each image; NaN errors do not count."""
    iteration, seconds, scene, is_draft, excluded = measurement
    errors = Errors(*(column.to("cpu", torch.float64, copy=True) for column in errors))
    for column in errors:
        column[excluded] = torch.nan
    is_missing = errors.objective.isnan()
    if not state.history and bool(is_missing.any()):
        raise InvalidArgument("objective", "a number at the first Gaussians of a fit", "NaN")
    if bool(is_missing.all()):
        return
    psnr, ef_psnr = decibel(errors.squared), decibel(errors.squared_near_contours)
    loss, mean_psnr, mean_ef_psnr = (float(numbers.nanmean()) for numbers in (errors.objective, psnr, ef_psnr))
    state.history.append(HistoryEntry(iteration, seconds, loss, mean_psnr, mean_ef_psnr, scene.num_gaussians))
    value = errors.squared if state.objective.is_ranked_by_psnr else errors.objective
    drafts = torch.full_like(is_missing, is_draft)
    measured = Best(scene.field, [scene.regions] * len(value), drafts, value, psnr)
    state.best = measured if state.best is None else state.best.improved_by(measured)


def decibel(mean_square: Tensor) -> Tensor:
    """Return the PSNR of mean squared errors, for values in [0, 1]."""
    return -10.0 * mean_square.log10()
