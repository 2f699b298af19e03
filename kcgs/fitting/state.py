"""The state of a fit: plain data, which the loop and the strategies read and change."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from kcgs.functional import RegionMap
from kcgs.optim import GaussianAdam
from kcgs.scene import Scene

from .optimizers import GaussianOptimizer
from .problem import Problem
from .readback import Readback
from .result import HistoryEntry


class Measurement(NamedTuple):
    """A scene that was measured, until its errors have arrived from the device."""

    iteration: int
    seconds: float
    scene: Scene  # a copy
    errors: Readback


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
    pending: list[Measurement] = field(default_factory=list)
    """Measurements whose errors are not in the history yet."""
    magnitudes: Readback | None = None
    """The largest absolute numbers of the field and its gradients some iterations ago, where the host runs ahead."""
    waits: bool = True
    """The next step waits for the device, to learn how much room the Gaussians take."""
    best: Scene | None = None
    """A copy of the best scene that was measured."""
    best_score: float = -math.inf
    """Its PSNR in dB, or what the objective has in its place."""

    @property
    def num_gaussians(self) -> int:
        """Gaussians at the moment."""
        return self.scene.num_gaussians

    @property
    def runs_ahead(self) -> bool:
        """True where a step waits for nothing, so that the host is some iterations before the device.

        A step that the device had no room for has gradients of NaN, which GaussianAdam leaves out, and others do not.
        """
        return not self.problem.image.is_cpu and isinstance(self.optimizer, GaussianAdam)

    @property
    def expected_iterations(self) -> float:
        """About how many iterations the fit will take."""
        config = self.problem.config
        if config.max_seconds is None:
            return config.usual_iterations
        return self.iteration / max(self.progress, 1e-9)
