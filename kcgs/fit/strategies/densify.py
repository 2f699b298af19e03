"""Gaussians are added where the error is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from kcgs.fit.descent import render, squared_error
from kcgs.fit.pursuit import Proposal, propose
from kcgs.fit.sampling import sample_pixels
from kcgs.fit.state import FitState
from kcgs.functional import lookup_regions

from .move_contours import MoveContours


@dataclass(frozen=True)
class Densify:
    """Add Gaussians where they lower the squared error most, by matching pursuit, region by region."""

    state: FitState
    contours: MoveContours | None = None
    """What moves the contours before an addition."""
    steps: int = 10
    """How often Gaussians are added."""
    begin: float = 0.05
    """Share of the fit at the first addition."""
    end: float = 0.5
    """Share of the fit at the last addition."""
    patience: float = 2.0
    """Where the clock ends the fit, descent gets this many times the seconds of the addition before it."""
    first_share: float = 0.8
    """About what the first addition takes, as a share of the seconds before it, most of which made the start."""
    sigmas: tuple[float, ...] = (0.7, 1.1, 1.8, 2.9, 4.7, 7.5)
    """Standard deviations in pixels that are tried."""

    def wanted(self, progress: float) -> int:
        """Return how many Gaussians there should be."""
        state = self.state
        if progress < self.begin:
            return state.first
        share = (progress - self.begin) / (self.end - self.begin)
        step = min(self.steps, 1 + int(share * (self.steps - 1)))
        return state.first + round((state.num_gaussians - state.first) * step / self.steps)

    def due(self, progress: float) -> bool:
        """Say whether Gaussians are wanted, and the clock has time for them."""
        state = self.state
        if self.wanted(progress) <= state.wanted:
            return False
        # against the clock, additions must end before the fit does, and leave time for the descent
        hurried = state.config.max_seconds is not None and progress < 0.9 * self.end
        in_time = state.has_time(state.addition_seconds or self.first_share * state.seconds())
        return in_time and not (hurried and state.seconds() < state.densify_after)

    @torch.no_grad()
    def apply(self, state: FitState) -> None:
        """Add Gaussians, after moving the contours, if that is due."""
        start = state.seconds()
        state.wanted = self.wanted(state.progress())
        state.densifications += 1
        if self.contours is not None:
            self.contours.before_addition(state)
        self.add(state, state.wanted - len(state.optimizer.gaussians()[0]))
        state.addition_seconds = state.seconds() - start
        state.densify_after = state.seconds() + self.patience * state.addition_seconds

    def add(self, state: FitState, count: int) -> None:
        """Add so many Gaussians, if any."""
        if count < 1:
            return
        added = self.place(state, count)
        state.optimizer.append(added.means, added.cholesky, added.colors)
        if state.region_ids is not None and added.region_ids is not None:
            state.region_ids = torch.cat([state.region_ids, added.region_ids])

    def place(self, state: FitState, count: int) -> Proposal:
        """Return the Gaussians to add."""
        residual = state.image - render(state)
        return propose(residual, state.regions, count, sigmas=self.sigmas, backend=state.config.backend)


@dataclass(frozen=True)
class DensifyAtLargestError(Densify):
    """Add Gaussians at pixels that are sampled in proportion to their squared error, as Image-GS does."""

    steps: int = 4
    end: float = 0.2

    def place(self, state: FitState, count: int) -> Proposal:
        """Return round Gaussians of half the spacing, of the colour that is missing at their pixel."""
        error = squared_error(state).flatten().double().cpu().numpy() + 1e-12
        rng = np.random.default_rng((state.seed, state.densifications))
        pixels = torch.from_numpy(sample_pixels(error, count, rng)).to(state.image.device)
        width = state.image.shape[2]
        means = torch.stack([pixels % width, pixels // width], -1).to(state.image.dtype) + 0.5
        sigma = means.new_full((count,), max(1.0, 0.5 * math.sqrt(len(error) / state.num_gaussians)))
        colors = (state.image - render(state)).flatten(1)[:, pixels].T
        ids = None if state.regions is None else lookup_regions(means, state.regions.labels)
        return Proposal(means, torch.stack([sigma, torch.zeros_like(sigma), sigma], -1), colors, ids)
