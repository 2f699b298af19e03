"""The history of a fit, and its best scene."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from kcgs.fitting.clock import Clock
from kcgs.fitting.problem import Problem
from kcgs.fitting.readback import Readback
from kcgs.fitting.result import HistoryEntry
from kcgs.fitting.state import FitState, Measurement
from kcgs.scene import Scene

# about how many entries a history has
_HISTORY_LENGTH = 100


class Log:
    """Measures the scene about a hundred times per fit, when there are no more than N Gaussians."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def due(self, state: FitState) -> float:
        """Return the progress of the next measurement, or somewhat less."""
        if state.problem.config.max_seconds is None:
            return state.next_multiple(_interval(state))
        return state.progress + 1.0 / _HISTORY_LENGTH if state.history or state.pending else 0.0

    def act(self, state: FitState) -> None:
        """Measure, and leave the render to the step, which differentiates it."""
        problem = state.problem
        if problem.config.max_seconds is None and state.iteration % _interval(state):
            return
        if state.num_gaussians <= problem.num_gaussians:
            with state.running_ahead():
                state.rendered = state.render()
                measure(state, state.scene, state.rendered, self.clock.seconds())


def _interval(state: FitState) -> int:
    """Return the iterations from one measurement to the next."""
    return max(1, state.problem.config.num_iterations // _HISTORY_LENGTH)


def measure(state: FitState, scene: Scene, rendered: Tensor, seconds: float) -> None:
    """Measure a render of a scene; the first measurement of a fit is waited for.

    A render of NaN, of a step that the device had no room for, is as if it were not measured.
    """
    errors = Readback((_errors_on_cpu if rendered.is_cpu else _errors_on_device)(state.problem, rendered.detach()))
    # of the Gaussians as they are now, since only the errors say whether they are the best
    scene = Scene(copy.deepcopy(scene.field), scene.regions)
    state.pending.append(Measurement(state.iteration, seconds, scene, errors))
    collect_measurements(state, wait=not state.history)


def collect_measurements(state: FitState, *, wait: bool) -> None:
    """Take the measurements that have arrived into the history, and keep the best scene; `wait`: all of them."""
    while state.pending and (wait or state.pending[0].errors.has_arrived()):
        iteration, seconds, scene, errors = state.pending.pop(0)
        loss, error, band_error, value = errors.numbers()
        if math.isnan(loss):
            continue
        psnr, ef_psnr = map(_decibel, (error, band_error))
        state.history.append(HistoryEntry(iteration, seconds, loss, psnr, ef_psnr, scene.num_gaussians))
        if value < state.best_value:
            state.best_value, state.best = value, scene


def _errors_on_cpu(problem: Problem, rendered: Tensor) -> Tensor:
    """Return mean errors of a render, (4,): loss, squared, squared at contours, and what the best has least of.

    The squared ones are those of the render clipped to [0, 1].
    """
    from kcgs.fitting.measurement import mean_errors  # loads numba

    render, image, band = (t.numpy() for t in (rendered, problem.image, problem.band))
    errors = mean_errors(render, image, band, problem.config.loss == "l2")
    value = errors[1] if problem.objective.is_ranked_by_psnr else float(problem.objective.value(rendered))
    loss = value if problem.has_own_loss else errors[0]
    return torch.tensor([loss, *errors[1:], value], dtype=torch.float64)


def _errors_on_device(problem: Problem, rendered: Tensor) -> Tensor:
    """Return the same where nobody waits for them."""
    image, objective, clipped = problem.image, problem.objective, rendered.clamp(0.0, 1.0)
    loss = problem.loss.value(rendered)
    error, band_error = mse_loss(clipped, image), loss.new_full((), math.nan)
    if len(problem.band):
        y, x = problem.band.unbind(1)
        band_error = mse_loss(clipped[:, y, x], image[:, y, x])
    value = error if objective.is_ranked_by_psnr else objective.value(rendered)
    return torch.stack([loss, error, band_error, value.to(loss.dtype)])


def _decibel(mean_square: float) -> float:
    """PSNR of a mean squared error, for values in [0, 1]."""
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
