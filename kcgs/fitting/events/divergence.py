"""The event that handles numbers that are not finite."""

from __future__ import annotations

from kcgs.fitting.state import FitState
from kcgs.fitting.steppers import Stepper


class HandleDivergence:
    """Exclude images with a number that is not finite or too large; end the fit when no image is left."""

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper

    def act(self, state: FitState) -> str | None:
        """Exclude overflowing images; return "diverged" when no image is left."""
        state.exclude(self._stepper.overflowing_images())
        return "diverged" if state.all_diverged else None
