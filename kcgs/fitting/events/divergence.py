"""The end of a fit whose numbers are not finite."""

from __future__ import annotations

from kcgs.fitting.state import FitState
from kcgs.fitting.steppers import Stepper


class HandleDivergence:
    """Excludes images with a number that is not finite, or too large; ends a fit of which no other image is left."""

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper

    def act(self, state: FitState) -> str | None:
        """Check, and return why the fit ends."""
        state.exclude(self._stepper.overflowing_images())
        return "diverged" if state.all_diverged else None
