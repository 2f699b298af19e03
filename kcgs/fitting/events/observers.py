"""Events of every fit: they handle divergence, measure the scene, and report each step."""

from __future__ import annotations

from collections.abc import Callable

from kcgs._progress import Progress
from kcgs.fitting.checkpoint import Checkpoint
from kcgs.fitting.measurement import Clock
from kcgs.fitting.result import HistoryEntry
from kcgs.fitting.state import FitState
from kcgs.fitting.stepper import Stepper

OnStep = Callable[[int, HistoryEntry], bool | None]

# least number of history entries, if there are as many iterations
_HISTORY_LENGTH = 100


class HandleDivergence:
    """Exclude images with a number that is not finite or too large; end the fit when no image is left."""

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper

    def act(self, state: FitState) -> str | None:
        """Exclude overflowing images; return "diverged" when no image is left."""
        state.exclude(self._stepper.overflowing_images())
        return "diverged" if state.all_diverged else None


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


class Report:
    """Report every step after the first measurement; end the fit when the user's callback returns True."""

    def __init__(
        self, stepper: Stepper, clock: Clock, bar: Progress, on_step: OnStep | None, checkpoint: Checkpoint | None
    ) -> None:
        self._stepper, self._clock, self._bar = stepper, clock, bar
        self._on_step, self._checkpoint = on_step, checkpoint
        self._has_stepped = False

    def act(self, state: FitState) -> str | None:
        """Record the measurements that have arrived, and report the last one."""
        if not self._has_stepped:
            self._has_stepped = True
            return None
        self._stepper.poll()
        if not state.history:  # a user's event may add more than N Gaussians at once: such scenes are not measured
            return None
        entry = state.history[-1]
        self._bar.update(
            state.progress, f"iteration {state.iteration}, {entry.num_gaussians} Gaussians, {entry.psnr:.2f} dB"
        )
        if self._checkpoint is not None and self._checkpoint.is_due(state):
            self._stepper.poll(wait=True)
            self._checkpoint.write(state, self._clock.seconds())
        if self._on_step is not None and self._on_step(state.iteration, entry):
            return "callback"
        return None
