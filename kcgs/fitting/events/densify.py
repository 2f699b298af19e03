"""The event that adds Gaussians where the error is large, and removes those of the lowest impact."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from kcgs.fitting.pursuit import add_gaussians
from kcgs.fitting.removal import remove_gaussians
from kcgs.fitting.state import FitState

from .contours import adapt_contours


@dataclass(frozen=True)
class Densify:
    """Add Gaussians where they lower the squared error most, by matching pursuit.

    First the number of Gaussians grows beyond N. Then cycles follow: each removes Gaussians of the lowest impact, in
    several steps, until N are left, and the next cycle adds as many again. So the positions of N Gaussians are chosen
    several times, each time given the others. While the number grows, contours move before additions.
    """

    steps: int = 8
    """Number of additions until the number of Gaussians is largest."""
    begin: float = 0.05
    """Share of the fit at the first addition."""
    end: float = 0.4
    """Share of the fit when the number of Gaussians is largest for the first time."""
    surplus: float = 0.2
    """Gaussians beyond N at the peak, as a share of N; not used if all N exist from the start."""
    settled: float = 0.8
    """Share of the fit after which there are N."""
    cycle: int = 100
    """About how many iterations a cycle takes."""
    removals: int = 4
    """Number of removals in a cycle."""

    def target(self, state: FitState, first: int) -> int:
        """Return the number of Gaussians that the schedule asks for, for an image that began with `first`."""
        final, progress = state.problem.num_gaussians, state.progress
        surplus = self.surplus if state.problem.config.densify_from < 1.0 else 0.0
        most = round((1 + surplus) * final)
        if progress < self.begin:
            return first
        if progress < self.end:
            share = (progress - self.begin) / (self.end - self.begin)
            return first + round((most - first) * (1 + int(share * (self.steps - 1))) / self.steps)
        if progress >= self.settled:
            return final
        phase = (progress - self.end) / (self.settled - self.end) * (state.num_cycles or self._num_cycles(state)) % 1.0
        return most - round((most - final) * int(phase * (self.removals + 1)) / self.removals)

    def _num_cycles(self, state: FitState) -> int:
        return max(1, round((self.settled - self.end) * state.expected_iterations / self.cycle))

    @torch.no_grad()
    def act(self, state: FitState) -> None:
        """Add or remove Gaussians if the schedule asks for another number and the history has an entry."""
        if state.num_cycles == 0 and state.progress >= self.end:  # fixed from now on, also in a fit with a clock
            state.num_cycles = self._num_cycles(state)
        target = self.target(state, state.num_initial)
        if not state.history or target == state.num_requested:
            return
        if target < state.num_requested:
            remove_gaussians(state, state.num_gaussians - target)
        else:
            state.num_additions += 1
            if state.problem.config.move_contours and state.progress < self.end:
                adapt_contours(state)
            self.add(state, target - state.num_gaussians)
        state.num_requested = target

    def add(self, state: FitState, count: int) -> None:
        """Add `count` Gaussians; images that began with fewer Gaussians than others get fewer, as in a fit alone."""
        most = self.target(state, state.num_initial)
        add_gaussians(state, count, [most - self.target(state, first) for first in state.initial_counts])
