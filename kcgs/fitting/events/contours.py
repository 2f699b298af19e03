"""Moves of contours: before additions of Gaussians, and as an event after densification."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from operator import is_not

import torch

from kcgs.fitting.contour_moves import move_contours
from kcgs.fitting.image_maps import join_maps, map_of, map_of_each
from kcgs.fitting.start import with_chosen_softness
from kcgs.fitting.state import FitState
from kcgs.maps import RegionMap
from kcgs.optim import Gaussians

# largest share of the time of a fit so far that moves of the contours may take
_CLOCK_SHARE = 0.25
# seconds per pixel that the first move is expected to take
_SECONDS_PER_PIXEL = 3e-7
# factor by which a move before an addition may raise the squared error around it: the Gaussians adapt to it later
_MAX_RISE = 1.5
# contours move before every second addition of Gaussians
_ADDITIONS_PER_MOVE = 2
# their softness is chosen again before the second addition of every four
_ADDITIONS_PER_SOFTNESS = 4


def adapt_contours(state: FitState) -> None:
    """Move the contours before some additions of Gaussians; choose their softness again if the settings ask for it."""
    if state.num_additions % _ADDITIONS_PER_MOVE:
        return
    _move_contours_of_all(state, _MAX_RISE)
    if state.regions is not None and state.num_additions % _ADDITIONS_PER_SOFTNESS == _ADDITIONS_PER_MOVE:
        _replace_maps(state, _choose_softness)


def _replace_maps(state: FitState, replace: Callable[[FitState, int, RegionMap], RegionMap]) -> None:
    """Replace the map of each image by a function of the state, the image's number and its map."""
    assert state.regions is not None
    before = map_of_each(state.regions, state.problem.num_images)
    after = [replace(state, image, regions) for image, regions in enumerate(before)]
    if any(map(is_not, after, before)):
        state.regions = join_maps(after)


def _choose_softness(state: FitState, image: int, regions: RegionMap) -> RegionMap:
    """Choose the softness of contours again, if the settings ask for it."""
    problem = state.problem
    return with_chosen_softness(problem.target[image], regions) if problem.chooses_softness(image) else regions


def _move_contours_of_all(state: FitState, max_rise: float) -> None:
    """Move the contours where this raises the squared error around them at most by the factor `max_rise`."""
    images, anchor, config = state.problem.image, state.anchor, state.problem.config
    if state.regions is None or anchor is None or images is None or not _has_time(state):
        return
    start, gaussians = time.perf_counter(), Gaussians.of(state.field)

    def moved(state: FitState, image: int, regions: RegionMap) -> RegionMap:
        renderer, labels = state.renderer.of_image(image, regions), map_of(anchor, image).labels
        return move_contours(gaussians.of_image(image), renderer, images[image], labels, config, max_rise)

    _replace_maps(state, moved)
    if config.max_seconds is not None:
        state.contour_seconds.append(time.perf_counter() - start)


def _has_time(state: FitState) -> bool:
    """Whether the clock, if there is one, has time for another move of the contours."""
    max_seconds, seconds = state.problem.config.max_seconds, state.contour_seconds
    if max_seconds is None:
        return True
    next_seconds = seconds[-1] if seconds else _SECONDS_PER_PIXEL * state.problem.target[:, 0].numel()
    return sum(seconds) + next_seconds <= _CLOCK_SHARE * state.progress * max_seconds


@dataclass(frozen=True)
class SettleContours:
    """Move the contours a few times after densification, where this lowers the error at once."""

    after: float
    """Share of the fit at the end of densification."""
    num_moves: int = 4
    """How often contours move, evenly over the rest of the fit."""

    @torch.no_grad()
    def act(self, state: FitState) -> None:
        """Move the contours, if it is time to."""
        move = state.num_late_moves + 1
        due = self.after + (1 - self.after) * move / (self.num_moves + 1)
        if move <= self.num_moves and state.progress >= due:
            state.num_late_moves = move
            _move_contours_of_all(state, max_rise=1.0)
