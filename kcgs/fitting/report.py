"""What is told of a fit after every step: its history, a bar, the user's callback, a checkpoint."""

from __future__ import annotations

from collections.abc import Callable

from kcgs._progress import Progress

from .clock import Clock
from .events.checkpoint import Checkpoint
from .events.log import collect_measurements
from .result import HistoryEntry
from .state import FitState

OnStep = Callable[[int, HistoryEntry], bool | None]


class Report:
    """Tells of every step, from the second iteration on; ends the fit where the callback says so."""

    def __init__(
        self, state: FitState, clock: Clock, bar: Progress, on_step: OnStep | None, store: Checkpoint | None
    ) -> None:
        self.first, self.clock, self.bar, self.on_step, self.store = state.iteration, clock, bar, on_step, store

    def due(self, state: FitState) -> float:
        """Return the progress of the moment."""
        return state.progress

    def act(self, state: FitState) -> str | None:
        """Take up what was measured, and tell of it."""
        if state.iteration == self.first:
            return None
        collect_measurements(state, wait=False)
        entry = state.history[-1]
        self.bar.update(
            state.progress, f"iteration {state.iteration}, {entry.num_gaussians} Gaussians, {entry.psnr:.2f} dB"
        )
        if self.store is not None:
            self.store.write(state, self.clock.seconds())
        if self.on_step is not None and self.on_step(state.iteration, entry):
            return "callback"
        return None
