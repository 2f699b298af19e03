"""The descent of a video frame from Gaussians of the frame before; a row stays the same Gaussian."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor

from kcgs.fitting import FitConfig, lowest_weighted_impact, move_contours, propose_for
from kcgs.optim import (
    OBJECTIVES,
    End,
    Event,
    Gaussians,
    NewtonDescent,
    Renderer,
    TimedAction,
    count_iterations,
    draft_cutoff,
    run,
    self_product,
)
from kcgs.scene import Scene

# These numbers are tuned: more iterations and relocations lower the error, but take longer and flicker more.

# iterations of each frame
_ITERATIONS = 85
# step size, as a share of the Newton step; larger steps oscillate
_RATE = 0.12
# iterations at the end with half the rate
_FINAL_ITERATIONS = 20
# contours move before this iteration
_CONTOUR_ITERATION = 30
# factor by which a move of a contour may raise the squared error around it: Gaussians adapt to it afterwards
_MAX_RISE = 1.5
# weight of the error of a row that may not move, far above all others: it is relocated only if its colour is 0
_FIXED_WEIGHT = 1e9
# usual sum of the weights of all Gaussians at a pixel; where the sum is larger, steps are shorter
_USUAL_OVERLAP = 12.0


def renderer_of(scene: Scene, config: FitConfig) -> Renderer:
    """Return the renderer of a frame in a fit: with the map of its scene, and the draft cutoff."""
    return Renderer(scene.size, scene.regions, draft_cutoff(config.cutoff), config.backend)


class FrameDescent(NewtonDescent):
    """Newton steps, relocations of rows and moves of contours towards an image.

    Newton steps hardly move Gaussians of still parts of a video; Adam moves them six times as far.

    Args:
        image: (C, H, W).
        scene: the start.
        config: of the fit, with an objective.
        movable_rows: Gaussians that may move, bool (N,).
        changed_pixels: pixels to which Gaussians may be relocated, bool (H, W).
    """

    def __init__(
        self, image: Tensor, scene: Scene, config: FitConfig, movable_rows: Tensor, changed_pixels: Tensor
    ) -> None:
        assert config.objective is not None
        objective = OBJECTIVES[config.objective](image)
        super().__init__(Gaussians.of(scene.field), objective, renderer_of(scene, config), min_sigma=config.min_sigma)
        self.image, self.start, self.config = image, scene, config
        self.movable_rows, self.changed_pixels = movable_rows, changed_pixels
        self.overlap = torch.ones_like(self.gaussians.means[:, 0])

    @property
    def scene(self) -> Scene:
        """The current Gaussians and map."""
        return Scene(self.gaussians.field(self.renderer.size), self.renderer.regions)

    def run(self, relocations: Mapping[int, float], anchor: Tensor | None = None) -> Scene:
        """Return the scene after the descent, or the start if its error is lower.

        Args:
            relocations: share of the movable rows that is relocated before an iteration, by iteration.
            anchor: labels from which contours move, at most as far as the config allows; None: contours stay.
        """
        before = self.squared_error()
        events: list[Event] = [
            End(),
            *(TimedAction([k / _ITERATIONS], partial(self._relocate, s)) for k, s in relocations.items()),
        ]
        if anchor is not None:
            events.append(TimedAction([_CONTOUR_ITERATION / _ITERATIONS], partial(self._move_contours, anchor)))
        final = (_ITERATIONS - _FINAL_ITERATIONS) / _ITERATIONS
        progress = count_iterations(self, _ITERATIONS)
        run(self, self.step, progress, events, lambda p: _RATE if p < final else 0.5 * _RATE)
        return self.scene if self.squared_error() <= before else self.start

    def squared_error(self) -> float:
        """Return the mean squared error."""
        return float(self.renderer.squared_error(self.gaussians, self.image).mean())

    def step(self, rate: float) -> None:
        """Move the movable rows once."""
        self.frozen = ~self.movable_rows[:, None]
        super().step(rate)

    def color_curvature(self) -> Tensor:
        """Return half the second derivative of the error with respect to a colour, larger where Gaussians overlap."""
        return super().color_curvature() * self.overlap

    def _relocate(self, share: float) -> None:
        """Relocate a share of the movable rows, those of the lowest impact, to where they lower the error most.

        Rows that lower the error nowhere become unused.
        """
        gaussians, renderer = self.gaussians, self.renderer
        count = round(share * int(self.movable_rows.sum()))
        visibility, self.overlap = self._overlap()
        weights = self.objective.weigh(gaussians) * visibility
        weights = torch.where(self.movable_rows, weights, _FIXED_WEIGHT)
        mask, new_colors = lowest_weighted_impact(renderer, gaussians, count, weights)
        colors = torch.where(self.movable_rows[:, None], new_colors, gaussians.colors)
        gaussians = gaussians._replace(colors=colors.masked_fill(mask[:, None], 0.0))
        self.velocity[mask], self.movable_rows = 0.0, self.movable_rows | mask

        rendered = torch.where(self.changed_pixels, renderer.render(gaussians), self.image)
        added = Gaussians.of(propose_for(self.objective, rendered, renderer, int(mask.sum())))
        rows = mask.nonzero()[: len(added.means), 0]
        self.gaussians = gaussians.map(lambda numbers, new: numbers.index_copy(0, rows, new), added)
        if gaussians.region_ids is not None and added.region_ids is not None:
            ids = gaussians.region_ids.index_copy(0, rows, added.region_ids)
            self.gaussians = self.gaussians._replace(region_ids=ids)

    def _overlap(self) -> tuple[Tensor, Tensor]:
        """Return the visible share of each Gaussian, and the factor by which it overlaps others, (N,) each.

        Overlapping Gaussians move together: with the second derivative of a single one, their steps would be too long.
        """
        total, sums = self.renderer.weight_sums(self.gaussians)
        areas = self_product(self.gaussians.cholesky)
        visibility = (sums(torch.ones_like(total)) / (2 * areas)).clamp_max(1.0)
        return visibility, (sums(total) / areas / _USUAL_OVERLAP).clamp_min(1.0)

    def _move_contours(self, anchor: Tensor) -> None:
        """Move contours; a move may raise the error around it by the factor `_MAX_RISE`."""
        regions = move_contours(self.gaussians, self.renderer, self.image, anchor, self.config, _MAX_RISE)
        self.renderer = self.renderer._replace(regions=regions)
