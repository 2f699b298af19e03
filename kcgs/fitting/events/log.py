"""The measurements of a fit."""

from __future__ import annotations

from kcgs.fitting.clock import Clock
from kcgs.fitting.state import FitState
from kcgs.fitting.steppers import Stepper

# least number of history entries, if there are as many iterations
_HISTORY_LENGTH = 100


class Log:
    """Measure the scene 100 to 200 times per fit, but only while there are at most N Gaussians."""

    def __init__(self, stepper: Stepper, clock: Clock) -> None:
        self._stepper, self._clock = stepper, clock
        self._next = 0.0  # progress of the next measurement, in a fit with a clock

    def act(self, state: FitState) -> None:
        """Measure the scene, if it is time to."""
        config = state.problem.config
        if config.max_seconds is None:
            if state.iteration % max(1, config.planned_iterations // _HISTORY_LENGTH):
                return
        elif state.progress < self._next:
            return
        self._next = state.progress + 1.0 / _HISTORY_LENGTH
        if state.num_gaussians <= state.problem.num_gaussians:
            self._stepper.measure(self._clock.seconds())
