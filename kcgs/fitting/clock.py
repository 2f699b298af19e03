"""The clock of a fit, and the end that it sets."""

from __future__ import annotations

import math
import time

from .state import FitState


class Clock:
    """Wall time of a fit, in seconds; a fit that goes on after a break starts at what it has used."""

    def __init__(self, seconds: float = 0.0) -> None:
        self._started = time.perf_counter() - seconds

    def seconds(self) -> float:
        """Seconds that the fit has used."""
        return time.perf_counter() - self._started


class EndOfTime:
    """Ends a fit whose seconds are over."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def due(self, state: FitState) -> float:
        """Return the end of the schedule, which follows the clock."""
        return 1.0

    def act(self, state: FitState) -> str | None:
        """Return that time is the reason, if it is."""
        return "seconds" if self.clock.seconds() >= (state.problem.config.max_seconds or math.inf) else None
