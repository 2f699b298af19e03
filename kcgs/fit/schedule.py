"""When things happen in a fit: learning rate, and how many Gaussians there should be."""

from __future__ import annotations

import math
from typing import Any

from .config import FitConfig

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
        if self.config.schedule == "step":
            return self.config.decay ** int(progress / self.config.decay_every)
        return _cosine(progress, self.config.decay)

    def wanted(self, progress: float) -> int:
        """How many Gaussians there should be."""
        begin, end = self.config.grow_between
        if progress < begin:
            return self.first
        share = 1.0 if end <= begin else (progress - begin) / (end - begin)
        step = min(self.config.grow_steps, 1 + int(share * (self.config.grow_steps - 1)))
        return self.first + round((self.total - self.first) * step / self.config.grow_steps)

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
        return max(self.config.decay, height * _cosine((progress - self.since) / length, self.config.decay))

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
    if config.target_psnr is not None and config.grow_from < 1.0:
        return TargetSchedule(config, num_gaussians, alive, config.target_psnr)
    return Schedule(config, num_gaussians, alive)


def _cosine(progress: float, floor: float) -> float:
    return floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
