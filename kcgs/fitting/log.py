"""The history of a fit, and its best scene."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor
from torch.nn.functional import l1_loss, mse_loss

from kcgs.scene import Scene

from .problem import Problem
from .readback import Readback
from .result import HistoryEntry
from .state import FitState, Measurement

# about how many entries a history has
_HISTORY_LENGTH = 100


def log_is_due(state: FitState, seconds: float) -> bool:
    """True about a hundred times per fit, when there are no more than N Gaussians."""
    config = state.problem.config
    if state.num_gaussians > state.problem.num_gaussians:
        return False
    if config.max_seconds is None:
        return state.iteration % max(1, config.usual_iterations // _HISTORY_LENGTH) == 0
    last = state.pending[-1] if state.pending else state.history[-1] if state.history else None
    return last is None or seconds >= last.seconds + config.max_seconds / _HISTORY_LENGTH


def log(state: FitState, rendered: Tensor, seconds: float, scene: Scene | None = None) -> None:
    """Measure a render of the state's scene, or of another; the first measurement of a fit is waited for.

    A render of NaN, of a step that the device had no room for, is as if it were not measured.
    """
    scene = scene or state.scene
    errors = Readback((_errors_on_cpu if rendered.is_cpu else _errors_on_device)(state.problem, rendered.detach()))
    # of the Gaussians as they are now, since only the errors say whether they are the best
    scene = Scene(copy.deepcopy(scene.field), scene.regions)
    state.pending.append(Measurement(state.iteration, seconds, scene, errors))
    take_up(state, wait=not state.history)


def take_up(state: FitState, *, wait: bool) -> None:
    """Take the measurements that have arrived into the history, and keep the best scene; `wait`: all of them."""
    while state.pending and (wait or state.pending[0].errors.has_arrived()):
        iteration, seconds, scene, errors = state.pending.pop(0)
        loss, error, band_error, score_error = errors.numbers()
        if math.isnan(loss):
            continue
        psnr, ef_psnr, score = map(_decibel, (error, band_error, score_error))
        state.history.append(HistoryEntry(iteration, seconds, loss, psnr, ef_psnr, scene.num_gaussians))
        if score > state.best_score:
            state.best_score, state.best = score, scene


def _errors_on_cpu(problem: Problem, rendered: Tensor) -> Tensor:
    """Return mean errors of a render, (4,): loss, squared, squared at contours, and what the objective has as such."""
    from .measurement import mean_errors  # loads numba

    image, objective = problem.image, problem.objective
    arrays = [t.numpy() for t in (rendered, image, problem.band)]
    errors = mean_errors(*arrays, problem.config.loss == "l2")
    score_error = errors[1] if objective is None else objective.value(rendered.clamp(0.0, 1.0) - image)
    return torch.tensor([*errors, score_error], dtype=torch.float64)


def _errors_on_device(problem: Problem, rendered: Tensor) -> Tensor:
    """Return the same where nobody waits for them."""
    image, objective, clipped = problem.image, problem.objective, rendered.clamp(0.0, 1.0)
    loss = (mse_loss if problem.config.loss == "l2" else l1_loss)(rendered, image)
    error, band_error = mse_loss(clipped, image), loss.new_full((), math.nan)
    if len(problem.band):
        y, x = problem.band.unbind(1)
        band_error = mse_loss(clipped[:, y, x], image[:, y, x])
    score_error = error if objective is None else objective.value_on_device(clipped - image)
    return torch.stack([loss, error, band_error, score_error.to(loss.dtype)])


def _decibel(mean_square: float) -> float:
    """PSNR of a mean squared error, for values in [0, 1]."""
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
