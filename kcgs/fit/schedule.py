"""When things happen in a fit: learning rate, and how many Gaussians there should be."""

from __future__ import annotations

import math
from typing import Any

from .config import FitConfig

# how often Gaussians are added, and between which fractions of the fit
DENSIFY_STEPS = 10
_DENSIFY_BEGIN, DENSIFY_END = 0.05, 0.5
# factor on the learning rate at the end of a cosine; at each step, and the fraction of the fit between steps
COSINE_END = 0.1
_STEP_DECAY, _STEP_EVERY = 0.5, 0.4
# PSNR (dB) that annealing still adds when growth ends
_ANNEALING_GAIN = 0.6
# PSNR (dB) that twice as many Gaussians add, on photos
_DOUBLING_GAIN = 2.5
# shares of the iterations: between additions, of the annealing, of each later attempt
_PAUSE, _ANNEALING, _ATTEMPT = 0.02, 0.4, 0.06
_FACTOR = 1.15


class Schedule:
    """A fit of a given number of Gaussians.

    Progress is the larger of the share of iterations and the share of seconds that are used up, so that learning rate
    and growth end in time whichever runs out first.
    """

    def __init__(self, config: FitConfig, num_gaussians: int, alive: int) -> None:
        self.config = config
        self.total = num_gaussians
        self.first = alive

    def progress(self, iteration: int, seconds: float) -> float:
        """Share of the fit that is done, 0 to 1."""
        return max(iteration / self.config.iterations, seconds / (self.config.max_seconds or math.inf))

    def rate(self, progress: float) -> float:
        """Factor on the learning rate."""
        if self.config.optimizer == "frame":
            return _cosine(progress)
        return _STEP_DECAY ** int(progress / _STEP_EVERY)

    def wanted(self, progress: float) -> int:
        """How many Gaussians there should be."""
        if progress < _DENSIFY_BEGIN:
            return self.first
        share = (progress - _DENSIFY_BEGIN) / (DENSIFY_END - _DENSIFY_BEGIN)
        step = min(DENSIFY_STEPS, 1 + int(share * (DENSIFY_STEPS - 1)))
        return self.first + round((self.total - self.first) * step / DENSIFY_STEPS)

    def observe(self, progress: float, psnr: float) -> None:
        """Take note of a measured PSNR."""

    def state(self) -> dict[str, Any]:
        """Return what a resumed fit needs."""
        return {}

    def load(self, state: dict[str, Any]) -> None:
        """Take up a state."""


class TargetSchedule(Schedule):
    """A fit with as few Gaussians as reach a PSNR, found by growth.

    Gaussians are added at a steady learning rate until the target is as near as annealing brings it; then the rate
    falls. Where the target is missed, as many are added as should close the gap, and the rate falls again from a third;
    and so on until the target is reached (the fit then stops), or the most allowed Gaussians are there.
    """

    def __init__(self, config: FitConfig, num_gaussians: int, alive: int, target: float) -> None:
        super().__init__(config, num_gaussians, alive)
        self.target = target
        self.now = alive
        self.since = 0.0  # progress when the present phase began
        self.phase = "growth"

    def rate(self, progress: float) -> float:
        """Factor on the learning rate."""
        if self.phase == "growth":
            return 1.0
        length, height = (_ANNEALING, 1.0) if self.phase == "annealing" else (_ATTEMPT, 0.3)
        return max(COSINE_END, height * _cosine((progress - self.since) / length))

    def wanted(self, progress: float) -> int:
        """How many Gaussians there should be."""
        return self.now

    def observe(self, progress: float, psnr: float) -> None:
        """Go on to the next phase, or add Gaussians, if it is time."""
        gap = self.target - psnr
        if self.phase == "growth":
            if gap <= _ANNEALING_GAIN or self.now >= self.total:
                self.phase, self.since = "annealing", progress
            elif progress - self.since >= _PAUSE:
                self._add(_FACTOR, progress)
        elif progress - self.since >= (_ANNEALING if self.phase == "annealing" else _ATTEMPT):
            self.phase = "attempt"
            self._add(2.0 ** (max(gap, 0.02) / _DOUBLING_GAIN), progress)

    def _add(self, factor: float, progress: float) -> None:
        self.now = min(self.total, max(self.now + 1, round(self.now * min(factor, 2.0))))
        self.since = progress

    def state(self) -> dict[str, Any]:
        """Return what a resumed fit needs."""
        return {"now": self.now, "since": self.since, "phase": self.phase}

    def load(self, state: dict[str, Any]) -> None:
        """Take up a state."""
        self.now, self.since, self.phase = state["now"], state["since"], state["phase"]


def make_schedule(config: FitConfig, num_gaussians: int, alive: int) -> Schedule:
    """Make the schedule that the settings ask for."""
    if config.target_psnr is not None and config.densify_from < 1.0:
        return TargetSchedule(config, num_gaussians, alive, config.target_psnr)
    return Schedule(config, num_gaussians, alive)


def _cosine(progress: float) -> float:
    return COSINE_END + (1 - COSINE_END) * 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
