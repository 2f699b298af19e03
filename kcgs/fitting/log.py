"""The history of a fit, and its best scene."""

from __future__ import annotations

import copy
import math

import numpy as np
from torch import Tensor

from kcgs.kernels.compiled import Program
from kcgs.scene import Scene

from .result import HistoryEntry
from .state import FitState

# about how many entries a history has
_HISTORY_LENGTH = 100

program = Program("measurement of a fit", __file__)


def log_is_due(state: FitState, seconds: float) -> bool:
    """True about a hundred times per fit, when there are no more than N Gaussians."""
    config = state.problem.config
    if state.num_gaussians > state.problem.num_gaussians:
        return False
    if config.max_seconds is None:
        return state.iteration % max(1, config.usual_iterations // _HISTORY_LENGTH) == 0
    return not state.history or seconds >= state.history[-1].seconds + config.max_seconds / _HISTORY_LENGTH


def log(state: FitState, rendered: Tensor, seconds: float, scene: Scene | None = None) -> None:
    """Measure a render of the state's scene, or of another, and keep a copy of the scene if it is the best so far."""
    scene, problem = scene or state.scene, state.problem
    rendered = rendered.detach()
    loss, error, band_error = _measure(rendered, problem.image, problem.config.loss == "l2", problem.band)
    psnr, ef_psnr = _decibel(error), _decibel(band_error)
    state.history.append(HistoryEntry(state.iteration, seconds, loss, psnr, ef_psnr, scene.num_gaussians))
    objective = problem.objective
    score = psnr if objective is None else _decibel(objective.value(rendered.clamp(0.0, 1.0) - problem.image))
    if score > state.best_score:
        state.best_score, state.best = score, Scene(copy.deepcopy(scene.field), scene.regions)


def _measure(rendered: Tensor, image: Tensor, is_squared: bool, band: Tensor | None) -> tuple[float, float, float]:
    """Return the loss, then the mean squared errors of the clipped render: everywhere, and in the band, or NaN."""
    rows = (t.cpu().numpy().reshape(-1, t.shape[-1]) for t in (rendered, image))
    loss, error = _mean_errors(*rows, is_squared)
    if band is None:
        return loss, error, math.nan
    values, targets = (t.flatten(1).index_select(1, band) for t in (rendered, image))
    return loss, error, float((values.clamp(0.0, 1.0) - targets).square().mean())


@program.entry
def _mean_errors(rendered, image, is_squared):  # type: ignore[no-untyped-def]
    """Return the mean error of rows (R, W), absolute or squared, and the mean squared error of the clipped render."""
    loss, squares = np.zeros((2, rendered.shape[1]))
    for y in range(len(rendered)):
        for x in range(rendered.shape[1]):
            difference = rendered[y, x] - image[y, x]
            loss[x] += difference * difference if is_squared else abs(difference)
            difference = min(max(rendered[y, x], rendered.dtype.type(0)), rendered.dtype.type(1)) - image[y, x]
            squares[x] += difference * difference
    return loss.sum() / rendered.size, squares.sum() / rendered.size


def _decibel(mean_square: float) -> float:
    """PSNR of a mean squared error, for values in [0, 1]."""
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
