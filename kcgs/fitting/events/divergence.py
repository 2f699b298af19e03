"""The end of a fit whose numbers are not finite."""

from __future__ import annotations

from kcgs._warn import warn_user
from kcgs.fitting.state import FitState
from kcgs.fitting.steppers import Stepper


class StopAtDivergence:
    """Ends a fit with a number that is not finite, or near overflow."""

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper

    def act(self, state: FitState) -> str | None:
        """Check, warn, and return why the fit ends."""
        if not self._stepper.has_diverged():
            return None
        warn_user(f"the fit diverged at iteration {state.iteration}: the best so far is kept")
        return "diverged"
