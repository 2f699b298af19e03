"""Gaussians are added where the error is, and left out where they are missed least."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from kcgs.fitting.descent import render, squared_error
from kcgs.fitting.objective import propose_by
from kcgs.fitting.pursuit import Proposal
from kcgs.fitting.sampling import sample_pixels
from kcgs.fitting.state import FitState
from kcgs.functional import lookup_regions

from .move_contours import MoveContours


@dataclass(frozen=True)
class Densify:
    """Add Gaussians where they lower the squared error most, by matching pursuit, region by region.

    First their number grows, to more than N. Then come cycles: in each, those that are missed least are left out, step
    by step, until there are N, and the next begins with as many again as there were. So N places are chosen several
    times over, each time knowing what the others do.
    """

    state: FitState
    contours: MoveContours | None = None
    """What moves the contours before an addition while the number grows."""
    steps: int = 8
    """How often Gaussians are added until there are most."""
    begin: float = 0.05
    """Share of the fit at the first addition."""
    end: float = 0.4
    """Share of the fit when there are most for the first time."""
    surplus: float = 0.2
    """Most Gaussians that there are, over N, less 1; not where all are there from the start."""
    settled: float = 0.8
    """Share of the fit from which on there are N."""
    cycle: int = 100
    """About how many iterations a cycle takes."""
    removals: int = 4
    """How often Gaussians are left out in a cycle."""
    sigmas: tuple[float, ...] = (0.7, 1.1, 1.8, 2.9, 4.7, 7.5)
    """Standard deviations in pixels that are tried."""

    def wanted(self, progress: float) -> int:
        """Return how many Gaussians there should be."""
        first, final = self.state.first, self.state.num_gaussians
        surplus = self.surplus if self.state.config.densify_from < 1.0 else 0.0
        most = round((1 + surplus) * final)
        if progress < self.begin:
            return first
        if progress < self.end:
            share = (progress - self.begin) / (self.end - self.begin)
            return first + round((most - first) * (1 + int(share * (self.steps - 1))) / self.steps)
        if progress >= self.settled:
            return final
        cycles = max(1, round((self.settled - self.end) * self.state.length() / self.cycle))
        share = (progress - self.end) / (self.settled - self.end) * cycles % 1.0
        return most - round((most - final) * int(share * (self.removals + 1)) / self.removals)

    def due(self, progress: float) -> bool:
        """Say whether another number of Gaussians is wanted, once one state was measured that may be kept."""
        return bool(self.state.history) and self.wanted(progress) != self.state.wanted

    @torch.no_grad()
    def apply(self, state: FitState) -> None:
        """Add Gaussians, after moving the contours, if that is due; or leave some out."""
        progress = state.progress()
        before, state.wanted = state.wanted, self.wanted(progress)
        if state.wanted < before:
            leave_out(state, state.count() - state.wanted)
            return
        state.densifications += 1
        if self.contours is not None and progress < self.end:
            self.contours.before_addition(state)
        self.add(state, state.wanted - state.count())

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
        residual, backend = state.image - render(state), state.config.backend
        return propose_by(state.objective, residual, state.regions, count, sigmas=self.sigmas, backend=backend)


def leave_out(state: FitState, count: int) -> None:
    """Leave out so many Gaussians, if any, those that are missed least; their neighbours make up for them."""
    from kcgs.fitting.redundancy import least_missed

    while count > 0:
        means, cholesky, colors, ids, regions = state.gaussians()
        index = torch.zeros(len(means), dtype=torch.int64) if regions is None or ids is None else regions.index_of(ids)
        table = torch.cat([means, cholesky, colors], -1).detach().cpu().numpy()
        weight = torch.ones(len(means)) if state.objective is None else state.objective.weigh(means, cholesky)
        geometry = table[:, :2], table[:, 2:5], table[:, 5:], index.cpu().numpy()
        goes, handed = least_missed(*geometry, count, weight.cpu().numpy())
        kept = torch.from_numpy(~goes).to(means.device)
        state.optimizer.recolor(torch.from_numpy(handed).to(colors))
        state.optimizer.keep(kept)
        state.region_ids = None if ids is None else ids[kept]
        count -= int(goes.sum())


@dataclass(frozen=True)
class DensifyAtLargestError(Densify):
    """Add Gaussians at pixels that are sampled in proportion to their squared error, as Image-GS does."""

    steps: int = 4
    end: float = 0.2
    surplus: float = 0.0

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
