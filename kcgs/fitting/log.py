"""The history of a fit, and its best scene."""

from __future__ import annotations

import copy
import math

from torch import Tensor

from kcgs.scene import Scene

from .result import HistoryEntry
from .state import FitState

# about how many entries a history has
_HISTORY_LENGTH = 100


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
    from .measurement import mean_errors  # loads numba

    scene, problem = scene or state.scene, state.problem
    rendered = rendered.detach()
    arrays = [t.cpu().numpy() for t in (rendered, problem.image, problem.band)]
    loss, error, band_error = mean_errors(*arrays, problem.config.loss == "l2")
    psnr, ef_psnr = _decibel(error), _decibel(band_error)
    state.history.append(HistoryEntry(state.iteration, seconds, loss, psnr, ef_psnr, scene.num_gaussians))
    objective = problem.objective
    score = psnr if objective is None else _decibel(objective.value(rendered.clamp(0.0, 1.0) - problem.image))
    if score > state.best_score:
        state.best_score, state.best = score, Scene(copy.deepcopy(scene.field), scene.regions)


def _decibel(mean_square: float) -> float:
    """PSNR of a mean squared error, for values in [0, 1]."""
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
