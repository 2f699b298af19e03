"""The descent of a frame from Gaussians that are nearly right, in which a row stays the same Gaussian."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from kcgs.fitting.contour_moves import move_contours
from kcgs.fitting.objective import make_objective, propose_gaussians
from kcgs.fitting.removal import lowest_impact
from kcgs.functional import RegionMap
from kcgs.optim.frame import widen
from kcgs.optim.newton import Gaussians, NewtonDescent, area, error_weights, half_gradients

from .splats import Splats, Target

# Numbers are tuned: more iterations and relocations lower the error, and take longer and flicker more.

# of each frame
_ITERATIONS = 85
# share of a Newton step in a step: larger ones oscillate
_RATE = 0.12
# iterations at the end, of half the rate
_FINAL_ITERATIONS = 20
# iteration before which contours move
_CONTOUR_ITERATION = 30
# factor by which a move of a contour may raise the squared error about it: Gaussians adapt to it afterwards
_MAX_RISE = 1.5
# pixels: no Gaussian gets thinner
_MIN_SIGMA = 0.5
# weight of the error of a row that may not move, so large that it is never relocated
_FIXED_WEIGHT = 1e9
# sum of the weights of all Gaussians at most pixels; where it is larger, steps are shorter
_USUAL_OVERLAP = 12.0


class FrameDescent:
    """Newton steps, relocations of rows and moves of contours towards an image.

    Newton steps, unlike Adam's, leave what is still in a video where it is: Adam moves it six times as far. They are
    those of :class:`kcgs.optim.newton.NewtonDescent`, which files take, too, for a price of bits and without contours.

    Args:
        target: the image.
        splats: the start.
        movable_rows: Gaussians that may move, bool (N,).
        changed_pixels: where Gaussians may be relocated to, bool (H, W).
    """

    def __init__(self, target: Target, splats: Splats, movable_rows: Tensor, changed_pixels: Tensor) -> None:
        self.target, self.splats = target, splats
        self.movable_rows, self.changed_pixels = movable_rows, changed_pixels
        self.objective = make_objective(target.config.objective, target.image)
        self.newton = NewtonDescent(Gaussians(*splats[:3]))
        self.overlap = torch.ones_like(splats.means[:, 0])

    def run(self, relocations: Mapping[int, float], anchor: Tensor | None = None) -> Splats:
        """Return the Gaussians after the descent, or the start if its error is lower.

        Args:
            relocations: share of the movable rows that is relocated, by the iteration before which it is.
            anchor: labels that contours move from, as far as the config allows; None: they stay.
        """
        start = self.splats
        for iteration in range(_ITERATIONS):
            if iteration in relocations:
                self._relocate(round(relocations[iteration] * int(self.movable_rows.sum())))
            if iteration == _CONTOUR_ITERATION and anchor is not None:
                self._move_contours(anchor)
            self._step(_RATE if iteration < _ITERATIONS - _FINAL_ITERATIONS else 0.5 * _RATE)
        errors = [float(self.target.squared_error(splats).mean()) for splats in (self.splats, start)]
        return self.splats if errors[0] <= errors[1] else start

    def _step(self, rate: float) -> None:
        """Move the movable rows once."""
        means, cholesky, colors, region_ids, regions = self.splats
        gaussians = Gaussians(means, cholesky, colors)
        gradients = half_gradients(self._render, gaussians, self.target.image, self.objective)
        color_curvature = area(cholesky) * error_weights(gaussians, self.objective) * self.overlap
        means, cholesky, colors = self.newton.step(
            gaussians, gradients, color_curvature, rate, ~self.movable_rows[:, None]
        )
        self.splats = Splats(means, widen(cholesky, _MIN_SIGMA), colors, region_ids, regions)

    def _render(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
        return self.target.render(self.splats._replace(means=means, cholesky=cholesky, colors=colors))

    def _relocate(self, count: int) -> None:
        """Move so many rows, those of the lowest impact, to where they lower the error most.

        Rows that lower it nowhere get the colour 0.
        """
        means, cholesky, colors, region_ids, regions = self.splats
        image, backend = self.target.image, self.target.config.backend
        visibility, self.overlap = self._overlap()
        weights = error_weights(Gaussians(means, cholesky, colors), self.objective) * visibility
        weights = torch.where(self.movable_rows, weights, _FIXED_WEIGHT)

        def products(cholesky: Tensor, colors: Tensor) -> Tensor:
            return self.target.inner_products(self.splats._replace(cholesky=cholesky, colors=colors))

        mask, new_colors = lowest_impact(products, cholesky, colors, count, weights)
        colors = torch.where(self.movable_rows[:, None], new_colors, colors).masked_fill(mask[:, None], 0.0)
        self.newton.velocity[mask], self.movable_rows = 0.0, self.movable_rows | mask

        residual = (image - self.target.render(self.splats._replace(colors=colors))) * self.changed_pixels
        proposal = propose_gaussians(self.objective, residual, regions, int(mask.sum()), backend)
        rows = mask.nonzero()[: len(proposal.means), 0]
        if region_ids is not None and proposal.region_ids is not None:
            region_ids = region_ids.index_copy(0, rows, proposal.region_ids)
        means = means.index_copy(0, rows, proposal.means)
        cholesky = cholesky.index_copy(0, rows, proposal.cholesky)
        colors = colors.index_copy(0, rows, proposal.colors)
        self.splats = Splats(means, cholesky, colors, region_ids, regions)

    def _overlap(self) -> tuple[Tensor, Tensor]:
        """Return the share of each Gaussian that is visible, and the factor by which its place is crowded, (N,) each.

        Gaussians in one place move together: with the second derivative of one alone, their steps would be too long.
        """
        total, sums = self.target.weight_sums(self.splats)
        areas = area(self.splats.cholesky)
        visibility = (sums(torch.ones_like(total)) / (2 * areas)).clamp_max(1.0)
        return visibility, (sums(total) / areas / _USUAL_OVERLAP).clamp_min(1.0)

    def _move_contours(self, anchor: Tensor) -> None:
        """Move contours to where the error is lower, or little higher."""
        scene, image = self.splats.scene(self.target.size), self.target.image

        def squared_error(regions: RegionMap) -> Tensor:
            return self.target.squared_error(self.splats._replace(regions=regions))

        regions = move_contours(scene, image, anchor, self.target.config, squared_error, _MAX_RISE)
        self.splats = self.splats._replace(regions=regions)
