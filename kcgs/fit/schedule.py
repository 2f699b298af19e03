"""When things happen in a fit."""

from __future__ import annotations

import math

from .config import FitConfig


class Schedule:
    """How far a fit is, and what is due there.

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
        return self.config.decay + (1 - self.config.decay) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))

    def growth_step(self, progress: float) -> int:
        """How many times Gaussians should have been added by now."""
        begin, end = self.config.grow_between
        if self.first >= self.total or progress < begin:
            return 0
        share = 1.0 if end <= begin else (progress - begin) / (end - begin)
        return min(self.config.grow_steps, 1 + int(share * (self.config.grow_steps - 1)))

    def alive(self, step: int) -> int:
        """How many Gaussians there should be after this many additions."""
        return self.first + round((self.total - self.first) * step / self.config.grow_steps)
