"""The state of a fit: plain data, which the loop and the strategies read and change."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from kcgs.functional import RegionMap
from kcgs.scene import Scene

from .optimizers import GaussianOptimizer
from .problem import Problem
from .result import HistoryEntry


@dataclass
class FitState:
    """A fit in progress: the start fills it, strategies change it, a checkpoint keeps it."""

    problem: Problem
    scene: Scene
    """What is rendered: the field that the optimizer moves, and the map, which strategies replace."""
    optimizer: GaussianOptimizer
    anchor: RegionMap | None
    """The map that contours may not move far from."""
    cutoff: float
    """Weights below it are skipped: first a draft's, at the end the result's."""
    num_initial: int
    """Gaussians at the start."""
    num_requested: int
    """Gaussians that the strategies last asked for; fewer exist where fewer were of use.

    A strategy that removes Gaussians lowers it: then `Densify`, after it in the list, adds as many elsewhere.
    """
    progress: float = 0.0
    """Share of the fit that is over: of its iterations or of its seconds, whichever is more."""
    iteration: int = 0
    num_additions: int = 0
    """How often Gaussians were added."""
    num_late_moves: int = 0
    """How often contours moved after densification."""
    history: list[HistoryEntry] = field(default_factory=list)
    best: Scene | None = None
    """A copy of the best scene that was measured."""
    best_score: float = -math.inf
    """Its PSNR in dB, or what the objective has in its place."""

    @property
    def num_gaussians(self) -> int:
        """Gaussians at the moment."""
        return self.scene.num_gaussians

    @property
    def expected_iterations(self) -> float:
        """About how many iterations the fit will take."""
        config = self.problem.config
        if config.max_seconds is None:
            return config.usual_iterations
        return self.iteration / max(self.progress, 1e-9)
