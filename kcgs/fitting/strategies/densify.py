"""Gaussians are added where the error is, and removed where that costs least."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from kcgs.fitting.descent import render, squared_error
from kcgs.fitting.initial import initial_sigma
from kcgs.fitting.objective import propose_gaussians
from kcgs.fitting.removal import remove_gaussians
from kcgs.fitting.sampling import sample_pixels
from kcgs.fitting.state import FitState
from kcgs.functional import lookup_regions
from kcgs.nn import GaussianField

from .contours import AdaptContours


@dataclass(frozen=True)
class Densify:
    """Add Gaussians where they lower the squared error most, by matching pursuit.

    First their number grows to more than N. Then come cycles: in each, those that cost least are removed, step by step,
    until there are N, and the next cycle adds as many again. So N places are chosen several times, each time with
    knowledge of the others.
    """

    contours: AdaptContours | None = None
    """Moves the contours before additions while the number of Gaussians grows."""
    steps: int = 8
    """Number of additions until the number of Gaussians is largest."""
    begin: float = 0.05
    """Share of the fit at the first addition."""
    end: float = 0.4
    """Share of the fit when the number of Gaussians is largest for the first time."""
    surplus: float = 0.2
    """Gaussians beyond N at the peak, as a share of N; 0 where all exist from the start."""
    settled: float = 0.8
    """Share of the fit from which on there are N."""
    cycle: int = 100
    """About how many iterations a cycle takes."""
    removals: int = 4
    """Number of removals in a cycle."""

    def target(self, state: FitState) -> int:
        """Return the number of Gaussians that the schedule asks for."""
        first, final, progress = state.num_initial, state.problem.num_gaussians, state.progress
        surplus = self.surplus if state.problem.config.densify_from < 1.0 else 0.0
        most = round((1 + surplus) * final)
        if progress < self.begin:
            return first
        if progress < self.end:
            share = (progress - self.begin) / (self.end - self.begin)
            return first + round((most - first) * (1 + int(share * (self.steps - 1))) / self.steps)
        if progress >= self.settled:
            return final
        cycles = max(1, round((self.settled - self.end) * state.expected_iterations / self.cycle))
        phase = (progress - self.end) / (self.settled - self.end) * cycles % 1.0
        return most - round((most - final) * int(phase * (self.removals + 1)) / self.removals)

    def due(self, state: FitState) -> bool:
        """True when the schedule asks for another number of Gaussians, and one state was measured."""
        return bool(state.history) and self.target(state) != state.num_requested

    @torch.no_grad()
    def apply(self, state: FitState) -> None:
        """Add or remove Gaussians."""
        target = self.target(state)
        if target < state.num_requested:
            remove_gaussians(state, state.num_gaussians - target)
        else:
            state.num_additions += 1
            if self.contours is not None and state.progress < self.end:
                self.contours.apply(state)
            self.add(state, target - state.num_gaussians)
        state.num_requested = target

    def add(self, state: FitState, count: int) -> None:
        """Add so many Gaussians, if any."""
        if count > 0:
            state.optimizer.append(state.scene.field, self.propose(state, count))

    def propose(self, state: FitState, count: int) -> GaussianField:
        """Return the Gaussians to add."""
        problem, residual = state.problem, state.problem.image - render(state)
        regions, backend = state.scene.regions, problem.config.backend
        return propose_gaussians(problem.objective, residual, regions, count, backend)


@dataclass(frozen=True)
class DensifyAtLargestError(Densify):
    """Add Gaussians at pixels that are sampled in proportion to their squared error, as Image-GS does."""

    steps: int = 4
    end: float = 0.2
    surplus: float = 0.0

    def propose(self, state: FitState, count: int) -> GaussianField:
        """Return round Gaussians of half the spacing, of the colour that their pixel lacks."""
        problem, regions = state.problem, state.scene.regions
        error = squared_error(state).flatten().double().cpu().numpy() + 1e-12
        rng = np.random.default_rng((problem.seed, state.num_additions))
        pixels = torch.from_numpy(sample_pixels(error, count, rng)).to(problem.image.device)
        width = problem.size[1]
        means = torch.stack([pixels % width, pixels // width], -1).to(problem.image.dtype) + 0.5
        sigma = means.new_full((count,), initial_sigma(problem.size, problem.num_gaussians))
        colors = (problem.image - render(state)).flatten(1)[:, pixels].T
        ids = None if regions is None else lookup_regions(means, regions.labels)
        cholesky = torch.stack([sigma, torch.zeros_like(sigma), sigma], -1)
        return GaussianField(means, cholesky, colors, ids, size=problem.size)
