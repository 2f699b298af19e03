"""The state of a fit: a descent, and what events read and change."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from operator import is_not
from typing import NamedTuple

import torch

from kcgs.functional import RegionMap
from kcgs.kernels import settle, without_waiting
from kcgs.optim import FieldDescent, GaussianAdam
from kcgs.scene import Scene

from .captured import CapturedStep
from .problem import Problem
from .readback import Readback
from .result import HistoryEntry

# at the start of a fit on a device that wait for it, since Gaussians may grow faster than the room for their lists
_CHECKED_ITERATIONS = 20


class Measurement(NamedTuple):
    """A scene that was measured, until its errors have arrived from the device."""

    iteration: int
    seconds: float
    scene: Scene  # a copy
    errors: Readback


@dataclass(kw_only=True)
class FitState(FieldDescent):
    """A fit in progress: the start fills it, events change it, a checkpoint keeps it."""

    problem: Problem
    anchor: RegionMap | None
    """The map that contours may not move far from."""
    num_initial: int
    """Gaussians at the start."""
    num_requested: int
    """Gaussians that the schedule last asked for; fewer exist where fewer were of use."""
    num_additions: int = 0
    """How often Gaussians were added."""
    num_late_moves: int = 0
    """How often contours moved after densification."""
    history: list[HistoryEntry] = field(default_factory=list)
    pending: list[Measurement] = field(default_factory=list)
    """Measurements whose errors are not in the history yet."""
    magnitudes: Readback | None = None
    """The largest absolute numbers of the field and its gradients some iterations ago, where the host runs ahead."""
    lacks_room: bool = False
    """A step on a device had no room for its lists."""
    best: Scene | None = None
    """A copy of the best scene that was measured."""
    best_value: float = math.inf
    """Its squared error, or what the objective has in its place."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._first, self._captured = self.iteration, CapturedStep()
        self._stepped: list[object] = []  # what the last step moved, and by what

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
            return config.num_iterations
        return self.iteration / max(self.progress, 1e-9)

    def next_multiple(self, interval: int) -> float:
        """Return the progress at this iteration, or the next that is a multiple of the interval, without a clock."""
        return -(-self.iteration // interval) * interval / self.problem.config.max_iterations

    @property
    def waits(self) -> bool:
        """True where the next step waits for the device, which after an event counts how much room its lists take."""
        content = self._content()
        return self.lacks_room or len(content) != len(self._stepped) or any(map(is_not, content, self._stepped))

    def _content(self) -> list[object]:
        return [self.field.means, self.field.cholesky, self.field.colors, self.field.region_ids, self.renderer]

    @property
    def is_settled(self) -> bool:
        """True where a render need not wait for the device."""
        return self.runs_ahead and not self.waits and self.iteration >= self._first + _CHECKED_ITERATIONS

    @property
    def replays(self) -> bool:
        """True where the next step is a kernel's programs alone, on a GPU, which a CUDA graph replays."""
        return self.is_settled and self.field.means.is_cuda and self.objective.has_fused_gradients(self.renderer)

    @contextmanager
    def running_ahead(self) -> Iterator[None]:
        """Render without waiting for the device, where that is possible, and without a graph that no step needs."""
        with without_waiting() if self.is_settled else nullcontext(), torch.set_grad_enabled(not self.replays):
            yield

    def step(self, rate: float) -> None:
        """Move the field once."""
        if self.runs_ahead and self.waits:
            settle(self.problem.image.device, self.problem.size)
            self._captured.forget()
        super().step(rate)
        self._stepped, self.lacks_room = self._content(), False

    def move(self) -> None:
        """Take a step, or replay one."""
        with self.running_ahead():
            if self.replays:
                self.rendered = None
                self._captured(self)
            else:
                super().move()
