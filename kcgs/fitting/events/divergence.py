"""The end of a fit whose numbers are not finite."""

from __future__ import annotations

from kcgs._warn import warn_user
from kcgs.fitting.state import FitState
from kcgs.fitting.steppers import Stepper


class HandleDivergence:
    """Freezes images with a number that is not finite, or near overflow; ends a fit of which no other image is left."""

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper

    def act(self, state: FitState) -> str | None:
        """Check, warn, and freeze, or return why the fit ends."""
        images = self._stepper.diverging()
        if not images:
            return None
        if state.problem.num_images == 1:
            warn_user(f"the fit diverged at iteration {state.iteration}: the best so far is kept")
        else:
            numbers = ", ".join(map(str, images))
            warn_user(f"images {numbers} diverged at iteration {state.iteration}: the best so far of each is kept")
        state.exclude(images)
        return "diverged" if state.has_diverged else None
