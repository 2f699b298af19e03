"""Search for the fewest Gaussians that reach a PSNR: a secant search in which each trial is a whole fit.

Every fit but the first continues the fit with the nearest number of Gaussians: some are added, or those of the lowest
impact are removed.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch

from kcgs.functional import psnr

from .measurement import Clock
from .problem import Problem
from .pursuit import add_gaussians
from .removal import remove_gaussians
from .result import FitResult
from .start import make_state, start
from .state import FitState

# pixels per Gaussian of the first fit
_FIRST_SPACING = 256
# expected gain in PSNR for twice as many Gaussians, in dB, on photos
_DECIBELS_PER_OCTAVE = 3.0
# The search ends when the least number of Gaussians that is enough is at most this multiple of the largest number that
# is too small.
_PRECISION = 1.04
# The search also ends when the secant predicts that less than this factor of Gaussians can be saved.
_EXPECTED_PRECISION = 1.025
# share of the schedule at which a continued fit starts
_WARM_START = 0.6

Run = Callable[[FitState], FitResult]


class _Trial(NamedTuple):
    num_gaussians: int
    psnr: float  # of the finished scene, clipped, in dB
    result: FitResult
    state: FitState


def search(problem: Problem, run: Run) -> FitResult:
    """Return the fit with the fewest Gaussians, at most N, that reaches `target_psnr`, else the fit with most PSNR.

    `run` runs a fit from its state to its end. If the clock ends the search, the best fit so far is returned.
    """
    clock, target = Clock(), problem.config.target_psnr
    assert target is not None
    trials: list[_Trial] = []
    count: int | None = min(problem.num_gaussians, max(1, problem.target[0, 0].numel() // _FIRST_SPACING))
    while count is not None:
        budget = (problem.config.max_seconds or math.inf) - clock.seconds()
        trials.append(_fit(problem, count, trials, budget, run))
        stopped = trials[-1].result.stop_reason in ("callback", "seconds")
        count = None if stopped else _next_count(trials, target, problem.num_gaussians)
    enough = [trial for trial in trials if trial.psnr >= target]
    best = min(enough, key=lambda t: t.num_gaussians) if enough else max(trials, key=lambda t: t.psnr)
    reason = trials[-1].result.stop_reason
    if enough and reason != "callback":
        reason = "target_psnr"
    return best.result._replace(stop_reason=reason, config=problem.config, seconds=clock.seconds())


def _fit(problem: Problem, count: int, trials: list[_Trial], seconds: float, run: Run) -> _Trial:
    """Fit `count` Gaussians, from the start or from the nearest trial."""
    config = problem.config
    changes = {
        "target_psnr": None,
        "max_seconds": None if math.isinf(seconds) else max(seconds, 1e-3),
        "iterations": config.planned_iterations,
    }
    settings = config.model_copy(update=changes)
    nearest = min(trials, key=lambda t: abs(math.log(t.num_gaussians / count)), default=None)
    problem = replace(problem, num_gaussians=count, config=settings)
    if nearest is not None and _can_go_on(problem, nearest):
        state = _warm_start(problem, nearest.state)
    else:
        state = start(problem)
    result = run(state)
    rendered = result.scene.render().to(problem.target).view_as(problem.target)
    return _Trial(count, float(psnr(rendered, problem.target)), result, state)


def _can_go_on(problem: Problem, trial: _Trial) -> bool:
    """Whether a fit may continue a trial: the regions of a trial may be merged for another number of Gaussians."""
    is_merged = problem.config.merge_regions and problem.num_excess_regions != trial.state.problem.num_excess_regions
    return trial.result.stop_reason != "diverged" and trial.state.optimizer.keeps_averages and not is_merged


def _warm_start(problem: Problem, finished: FitState) -> FitState:
    """Return the state of a fit that continues another fit with more or fewer Gaussians."""
    count, field = problem.num_gaussians, copy.deepcopy(finished.field)
    state = make_state(
        problem, field, finished.regions, count, anchor=finished.anchor, num_additions=finished.num_additions,
        iteration=round(_WARM_START * problem.config.planned_iterations),
    )  # fmt: skip
    state.optimizer.load_state_dict(copy.deepcopy(finished.optimizer.state_dict()))
    remove_gaussians(state, state.num_gaussians - count)
    with torch.no_grad():
        add_gaussians(state, count - state.num_gaussians)
    return state


def _next_count(trials: list[_Trial], target: float, most: int) -> int | None:
    """Return how many Gaussians to try next; None: the answer is known."""
    high = min((t for t in trials if t.psnr >= target), key=lambda t: t.num_gaussians, default=None)
    fewer = (t for t in trials if t.psnr < target and (high is None or t.num_gaussians < high.num_gaussians))
    low = max(fewer, key=lambda t: t.num_gaussians, default=None)
    if high is None:
        assert low is not None
        octaves = max((target - low.psnr) / _DECIBELS_PER_OCTAVE, math.log2(_PRECISION))
        more = max(low.num_gaussians + 1, min(most, round(low.num_gaussians * 2.0**octaves)))
        return None if low.num_gaussians == most else more
    slope = _DECIBELS_PER_OCTAVE
    if low is not None:
        ratio = high.num_gaussians / low.num_gaussians
        slope = (high.psnr - low.psnr) / math.log2(ratio)
        if low.num_gaussians == high.num_gaussians - 1 or ratio <= _PRECISION:
            return None
    octaves = (high.psnr - target) / slope
    if high.num_gaussians == 1 or octaves < math.log2(_EXPECTED_PRECISION):
        return None
    expected: float = high.num_gaussians / 2.0**octaves
    if low is not None:  # a plain secant of a bent curve would converge from one side only
        expected = math.sqrt(expected * math.sqrt(low.num_gaussians * high.num_gaussians))
    return min(max(round(expected), 1 if low is None else low.num_gaussians + 1), high.num_gaussians - 1)
