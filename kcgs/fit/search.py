"""How a fit finds the fewest Gaussians that reach a PSNR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal


@dataclass
class TargetSearch:
    """Gaussians are added at a steady learning rate until the target is as near as annealing brings it.

    Then the rate falls. Where the target is missed, as many are added as should close the gap, and the rate falls again
    from a third; and so on until the target is reached (the fit then stops), or the most allowed Gaussians are there.
    """

    target: float
    """PSNR in dB."""
    most: int
    """Gaussians that there may be."""
    wanted: int
    """Gaussians that there should be now."""
    phase: Literal["densify", "anneal", "attempt"] = "densify"
    since: float = 0.0
    """Progress when the phase began, or Gaussians were last added."""

    annealing_gain: float = 0.6
    """PSNR in dB that annealing still adds when densification ends."""
    doubling_gain: float = 2.5
    """PSNR in dB that twice as many Gaussians add, on photos."""
    pause: float = 0.02
    """Share of the fit between additions."""
    annealing: float = 0.4
    """Share of the fit that annealing takes."""
    attempt: float = 0.06
    """Share of the fit that each later attempt takes."""
    factor: float = 1.15
    """Growth of the number of Gaussians with each addition."""

    def rate(self, progress: float, decay: Callable[[float], float]) -> float:
        """Return the factor on the learning rates, from an optimizer's own as a function of progress."""
        if self.phase == "densify":
            return 1.0
        length, height = (self.annealing, 1.0) if self.phase == "anneal" else (self.attempt, 0.3)
        return max(decay(1.0), height * decay((progress - self.since) / length))

    def observe(self, progress: float, psnr: float) -> None:
        """Go on to the next phase, or ask for more Gaussians, if it is time."""
        gap = self.target - psnr
        if self.phase == "densify":
            if gap <= self.annealing_gain or self.wanted >= self.most:
                self.phase, self.since = "anneal", progress
            elif progress - self.since >= self.pause:
                self._add(self.factor, progress)
        elif progress - self.since >= (self.annealing if self.phase == "anneal" else self.attempt):
            self.phase = "attempt"
            self._add(2.0 ** (max(gap, 0.02) / self.doubling_gain), progress)

    def _add(self, factor: float, progress: float) -> None:
        self.wanted = min(self.most, max(self.wanted + 1, round(self.wanted * min(factor, 2.0))))
        self.since = progress
