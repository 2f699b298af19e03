"""The event that reports each step: to the history, a progress bar, the user's callback and a checkpoint."""

from __future__ import annotations

from collections.abc import Callable

from kcgs._progress import Progress
from kcgs.fitting.checkpoint import Checkpoint
from kcgs.fitting.clock import Clock
from kcgs.fitting.result import HistoryEntry
from kcgs.fitting.state import FitState
from kcgs.fitting.steppers import Stepper

OnStep = Callable[[int, HistoryEntry], bool | None]


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
