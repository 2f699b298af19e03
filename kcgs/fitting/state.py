"""The state of a fit, and what happens to it when a scene was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap
from kcgs.optim import FieldState, is_within
from kcgs.scene import Scene

from .problem import Problem
from .result import HistoryEntry

# numbers beyond it are near overflow
LARGEST = 1e15


@dataclass(kw_only=True, repr=False)
class FitState(FieldState):
    """A fit in progress: the start fills it, events and steps change it, a checkpoint keeps it."""

    problem: Problem
    anchor: RegionMap | None
    """The map that contours may not move far from."""
    num_initial: int
    """Gaussians at the start."""
    num_requested: int
    """Gaussians that the schedule last asked for; fewer exist where fewer were of use."""
    num_additions: int = 0
    """How often Gaussians were added."""
    num_cycles: int = 0
    """Cycles of removals and additions; 0 while the number of Gaussians still grows."""
    num_late_moves: int = 0
    """How often contours moved after densification."""
    history: list[HistoryEntry] = field(default_factory=list)
    best: Scene | None = None
    """A copy of the best scene that was measured."""
    best_is_draft: bool = True
    """The best was rendered with the cutoff of a draft, and any scene that is none beats it."""
    best_value: float = math.inf
    """Squared error of the best, or value of the objective; see `Objective.is_ranked_by_psnr`."""
    best_psnr: float = math.nan
    """Of the best, in dB."""

    def __repr__(self) -> str:
        return f"FitState(iteration {self.iteration}, progress {self.progress:.2f}, {self.scene!r})"

    @property
    def scene(self) -> Scene:
        """The field that the optimizer moves, and the map."""
        return Scene(self.field, self.regions)

    @property
    def num_gaussians(self) -> int:
        """Gaussians at the moment."""
        return self.field.num_gaussians

    @property
    def is_draft(self) -> bool:
        """True where the cutoff is not yet that of the result."""
        return self.renderer.cutoff != self.problem.config.cutoff

    @property
    def is_finite(self) -> bool:
        """True where every number of the field is finite, and far from overflow."""
        return is_within([self.field.means, self.field.cholesky, self.field.colors], LARGEST)

    @property
    def expected_iterations(self) -> float:
        """About how many iterations the fit will take."""
        config = self.problem.config
        if config.max_seconds is None:
            return config.planned_iterations
        return self.iteration / max(self.progress, 1e-9)

    def end_drafts(self) -> None:
        """Render with the cutoff of the result from here on."""
        self.renderer = self.renderer._replace(cutoff=self.problem.config.cutoff)


class Measurement(NamedTuple):
    """A scene that was rendered, and when."""

    iteration: int
    seconds: float
    scene: Scene  # a copy, since the fit goes on
    is_draft: bool


class Errors(NamedTuple):
    """Mean errors of a render."""

    objective: float
    squared: float  # once it is clipped to [0, 1]; NaN without an image
    squared_near_contours: float  # the same in the band of EF-PSNR; NaN without contours


def record(state: FitState, measurement: Measurement, errors: Errors) -> None:
    """Put a measurement into the history, and keep its scene if it is the best; one of NaN does not count."""
    iteration, seconds, scene, is_draft = measurement
    if math.isnan(errors.objective):
        if not state.history:
            raise InvalidArgument("objective", "a number at the first Gaussians of a fit", "NaN")
        return
    psnr, ef_psnr = _decibel(errors.squared), _decibel(errors.squared_near_contours)
    state.history.append(HistoryEntry(iteration, seconds, errors.objective, psnr, ef_psnr, scene.num_gaussians))
    value = errors.squared if state.objective.is_ranked_by_psnr else errors.objective
    if (is_draft, value) < (state.best_is_draft, state.best_value):
        state.best, state.best_is_draft, state.best_value, state.best_psnr = scene, is_draft, value, psnr


def _decibel(mean_square: float) -> float:
    """PSNR of a mean squared error, for values in [0, 1]."""
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
