"""Which contours help: short trials with and without them."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kcgs.fitting.colors import solve_colors
from kcgs.fitting.descent import descend, render, squared_error
from kcgs.fitting.start import begin
from kcgs.fitting.state import FitState

from .densify import Densify


@dataclass(frozen=True)
class MergeRegions:
    """Merge the touching regions that are rendered better without the contour between them.

    Two trials, one with all contours and one with none, are compared over the pixels nearest to each pair's contour:
    :meth:`before` the fit from its first Gaussians, and once the last are there from the state of the moment, after a
    solution of the colours. What confined Gaussians learnt by then is little use to unconfined ones: it takes both.
    """

    state: FitState
    after: float = Densify.end
    """Share of the fit when the trial is made: the end of densification."""
    trial: float = 0.05
    """Steps of the trial, as a share of those so far."""
    solve_steps: int = 8
    """Steps of the solution for the colours."""
    rehearsal: int = 20
    """Steps of the fits that are compared before the start."""
    margin: float = 0.25
    """Share of the error that must be saved: contours stay unless they plainly harm, for they are sharp where it
    shows."""
    reach: float = 12.0
    """Pixels about a contour in which its help is measured."""
    before_share: float = 0.03
    """Share of the seconds that a fit may have used and still make the trial at the start."""
    trial_iterations: int = 60
    """What the later trial costs, in iterations."""
    trial_share: float = 0.1
    """Share of the seconds that the later trial may take."""

    def before(self, state: FitState) -> None:
        """Leave out, before the fit, the contours that are no help from the start, and begin with the others."""
        regions = state.regions
        in_time = state.seconds() < self.before_share * (state.config.max_seconds or math.inf)
        if regions is None or regions.supersample > 1 or not in_time:
            return
        errors = []
        for tried in (regions, None):
            begin(state, tried)
            errors.append(self._error_after(state, self.rehearsal))
        pairs = self.harmful_pairs(regions.labels, *errors)
        begin(state, regions.merge(pairs)[0] if pairs else regions)

    def due(self, progress: float) -> bool:
        """Say whether the one trial is to be made."""
        return not self.state.merged and progress >= self.after

    def apply(self, state: FitState) -> None:
        """Merge, once, the regions that a trial renders better without a contour between them."""
        state.merged = True
        cost = self.trial_iterations * state.seconds() / max(1, state.iteration)
        in_time = cost < self.trial_share * (state.config.max_seconds or math.inf)
        regions, ids = state.regions, state.region_ids
        if regions is None or ids is None or regions.supersample > 1 or not in_time:
            return
        kept, iteration = copy.deepcopy(state.optimizer.state_dict()), state.iteration
        steps = max(5, round(self.trial * iteration))
        errors = []
        for tried, tried_ids in ((regions, ids), (None, None)):
            state.regions, state.region_ids = tried, tried_ids
            self._solve(state)
            errors.append(self._error_after(state, steps))
            state.iteration = iteration
            state.optimizer.load_state_dict(copy.deepcopy(kept))
        state.regions, state.region_ids = regions, ids
        pairs = self.harmful_pairs(regions.labels, *errors)
        if pairs:
            state.regions, new_ids = regions.merge(pairs)
            state.region_ids = None if state.regions is None else new_ids[regions.index_of(ids)]
            state.anchor = None if state.anchor is None else new_ids[regions.index_of(state.anchor)]
            self._solve(state)

    def _error_after(self, state: FitState, steps: int) -> Tensor:
        """Squared error of each pixel after some steps; infinite where they diverge."""
        progress = state.progress()
        for _ in range(steps):
            descend(state, render(state), progress)
            if not state.optimizer.is_finite():
                return torch.full_like(state.image[0], math.inf)
        with torch.no_grad():
            return squared_error(state)

    def _solve(self, state: FitState) -> None:
        settings = {"steps": self.solve_steps, "cutoff": state.cutoff, "backend": state.config.backend}
        solved = solve_colors(state.gaussians().scene(state.size), state.image, **settings)  # type: ignore[arg-type]
        state.optimizer.recolor(solved.field.colors.detach())

    def harmful_pairs(self, labels: Tensor, with_contours: Tensor, without: Tensor) -> list[tuple[int, int]]:
        """Pairs without whose contour the error is plainly less; two regions share all pixels of the image."""
        if not bool(torch.isfinite(with_contours + without).all()):
            return []  # a trial that diverged tells nothing
        difference = without - (1 - self.margin) * with_contours
        ids = torch.unique(labels)
        if len(ids) == 2:
            return [(int(ids[0]), int(ids[1]))] if float(difference.sum()) < 0 else []
        labels, across, distance = nearest_contour(labels)
        near = distance <= self.reach
        low, high = torch.minimum(labels, across)[near], torch.maximum(labels, across)[near]
        pairs, index = torch.unique(torch.stack([low, high], -1), dim=0, return_inverse=True)
        sums = torch.zeros(len(pairs), dtype=difference.dtype).index_add_(0, index, difference.cpu()[near])
        return [(int(a), int(b)) for (a, b), total in zip(pairs.tolist(), sums.tolist(), strict=True) if total < 0]


def nearest_contour(labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For every pixel: its label, the label on the other side of the nearest contour, and the distance in pixels."""
    from scipy import ndimage

    values = labels.cpu().numpy()
    other, padded = values, np.pad(values, 1, "edge")
    for neighbor in (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]):
        other = np.where(other == values, neighbor, other)
    distance, (row, column) = ndimage.distance_transform_edt(other == values, return_indices=True)
    across = np.where(values[row, column] == values, other[row, column], values[row, column])
    return labels.cpu(), torch.from_numpy(across), torch.from_numpy(distance)
