"""A short descent from Gaussians that are nearly right, in which no row changes its place."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from kcgs.fitting import FitConfig
from kcgs.fitting.contour_moves import accept_moves, refine_contours
from kcgs.fitting.objective import make_objective, propose_for
from kcgs.fitting.redundancy import lowest_impact
from kcgs.fitting.start import draft_cutoff
from kcgs.fitting.strategies import AdaptContours
from kcgs.functional import region_splat
from kcgs.optim.frame import area, move, newton_steps, widen

from .gaussians import Gaussians

_ITERATIONS = 85
# standard deviations in pixels that are tried for a relocated Gaussian
_SIGMAS = (0.7, 1.1, 1.8, 2.9, 4.7, 7.5)
# iteration before which contours move
_CONTOUR_MOVE = 30
# iterations at the end, of half the rate
_LAST_ITERATIONS = 20
# share of a Newton step in a step, and of the step before
_RATE = 0.12
_MOMENTUM = 0.9
# bound of a step, in the Gaussian's frame
_LARGEST_STEP = 0.2
# what relocating a row of a region that stands still costs
_HELD = 1e9
# Gaussians at one place, as most places have them at most
_USUAL_OVERLAP = 12.0
# pixels: no Gaussian gets thinner
_LEAST_SIGMA = 0.5


class Descent:
    """Gaussians on their way to an image: Newton steps of every number alone, with momentum.

    What has a small gradient hardly moves, so that what stands still in a video stays where it is; Adam, whose steps
    are as long for small gradients as for large ones, moves it six times as far.

    Args:
        image: (C, H, W).
        gaussians: where the descent begins.
        config: of the fit: its objective, its contour settings and its backend.
        free: the rows that may move, bool (N,).
        changed: where rows may be relocated to, bool (H, W).
    """

    def __init__(self, image: Tensor, gaussians: Gaussians, config: FitConfig, free: Tensor, changed: Tensor) -> None:
        self.image, self.gaussians, self.config = image, gaussians.detached(), config
        self.objective = make_objective(config.objective, image)
        self.velocity = torch.zeros_like(torch.cat([gaussians.means, gaussians.cholesky, gaussians.colors], -1))
        self.free, self.changed = free, changed
        self.crowding = torch.ones_like(gaussians.means[:, 0])

    def run(self, relocations: Mapping[int, float], anchor: Tensor | None = None) -> Gaussians:
        """Descend.

        Args:
            relocations: what share of the rows that may move is relocated before which iterations.
            anchor: labels that contours may move from, as far as the config says; None: they stay.
        """
        start, error = self.gaussians, self.error()
        for iteration in range(_ITERATIONS):
            if iteration in relocations:
                self.relocate(round(relocations[iteration] * int(self.free.sum())))
            if iteration == _CONTOUR_MOVE and anchor is not None and self.config.move_contours:
                self.move_contours(anchor)
            self.step(_RATE if iteration < _ITERATIONS - _LAST_ITERATIONS else 0.5 * _RATE)
        # also where steps were too long and the error is not finite
        return self.gaussians if self.error() <= error else start

    def error(self) -> float:
        """Mean squared error."""
        return float(squared_error(self.gaussians, self.image, self.config).mean())

    def step(self, rate: float) -> None:
        """Move all Gaussians once."""
        means, cholesky, colors, ids, regions = self.gaussians
        leaves = x, factors, c = [t.detach().requires_grad_() for t in (means, cholesky, colors)]
        with torch.enable_grad():
            rendered = render_draft(Gaussians(x, factors, c, ids, regions), self.image, self.config)
        difference = rendered.detach() - self.image
        if self.objective is not None:
            difference = self.objective.apply(difference)
        slopes = torch.autograd.grad(rendered, leaves, difference)
        areas = area(cholesky) * self._weights() * self.crowding
        self.velocity = _MOMENTUM * self.velocity + newton_steps(cholesky, colors, slopes, areas)
        change = rate * self.velocity * self.free[:, None]
        means, cholesky = move(means, cholesky, change[:, :5].clamp(-_LARGEST_STEP, _LARGEST_STEP))
        self.gaussians = Gaussians(means, widen(cholesky, _LEAST_SIGMA), colors + change[:, 5:], ids, regions)

    def relocate(self, count: int) -> None:
        """Put so many rows, those that are missed least, where they lower the error most; neighbours make up for them.

        Rows for which there is no use get the colour 0.
        """
        means, cholesky, colors, ids, regions = self.gaussians
        rows = means, cholesky, colors, region_positions(self.gaussians, self.image)[0]
        visible, self.crowding = self._visibility()
        weight = torch.where(self.free, self._weights() * visible, _HELD).cpu().numpy()
        x, factors, c, index = (t.cpu().numpy() for t in rows)
        goes, handed = lowest_impact(x, factors, c, index, count, weight)
        relocated = torch.from_numpy(goes).to(means.device)
        colors = torch.from_numpy(handed).to(colors).masked_fill(relocated[:, None], 0.0)
        self.gaussians = self.gaussians._replace(colors=colors)
        self.velocity[relocated], self.free = 0.0, self.free | relocated
        residual = (self.image - render_draft(self.gaussians, self.image, self.config)) * self.changed
        count = int(relocated.sum())
        added = propose_for(self.objective, residual, regions, count, sigmas=_SIGMAS, backend=self.config.backend)
        places = relocated.nonzero()[: len(added.means), 0]
        if ids is not None and added.region_ids is not None:
            ids = ids.index_copy(0, places, added.region_ids)
        means, cholesky, colors = (
            old.index_copy(0, places, new)
            for old, new in zip((means, cholesky, colors), (added.means, added.cholesky, added.colors), strict=True)
        )
        self.gaussians = Gaussians(means, cholesky, colors, ids, regions)

    def move_contours(self, anchor: Tensor) -> None:
        """Move contours where the image is explained better, or nearly as well: Gaussians will adapt to them."""
        before, config = self.gaussians.regions, self.config
        if before is None or before.num_regions == 1:
            return
        moved = refine_contours(
            self.gaussians.scene(before.size), self.image, anchor=anchor,
            max_distance=None if config.max_move == "any" else config.max_move, length_weight=config.contour_cost,
            backend=config.backend,
        )  # fmt: skip
        if moved is before:
            return
        errors = [
            squared_error(self.gaussians._replace(regions=regions), self.image, config) for regions in (before, moved)
        ]
        accepted = accept_moves(before, moved, AdaptContours.max_rise * errors[0] - errors[1])
        self.gaussians = self.gaussians._replace(regions=accepted)

    def _visibility(self) -> tuple[Tensor, Tensor]:
        """Return what share of each Gaussian is painted, (N,), and the factor of its curvature, (N,).

        Many Gaussians at one place move together: with the curvature of one alone, their steps would be too long.
        """
        total, sums = sum_over_pixels(self.gaussians, self.image, self.config)
        mass, overlap = sums(torch.ones_like(total)), sums(total)
        areas = area(self.gaussians.cholesky)
        return (mass / (2 * areas)).clamp_max(1.0), (overlap / areas / _USUAL_OVERLAP).clamp_min(1.0)

    def _weights(self) -> Tensor:
        """Return what the squared error of Gaussians counts in the objective, (N,)."""
        means, cholesky = self.gaussians[:2]
        return torch.ones_like(means[:, 0]) if self.objective is None else self.objective.weigh(means, cholesky)


def render_draft(gaussians: Gaussians, image: Tensor, config: FitConfig) -> Tensor:
    """Render (C, H, W), of the size of the image, with the cutoff of a draft."""
    means, cholesky, colors, region_ids, regions = gaussians
    size, cutoff = (image.shape[1], image.shape[2]), draft_cutoff(config)
    return region_splat(means, cholesky, colors, region_ids, regions, size=size, cutoff=cutoff, backend=config.backend)


def squared_error(gaussians: Gaussians, image: Tensor, config: FitConfig) -> Tensor:
    """Squared error of each pixel, (H, W), channels averaged."""
    return (render_draft(gaussians, image, config) - image).square().mean(0)


def sum_over_pixels(
    gaussians: Gaussians, image: Tensor, config: FitConfig
) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return the sum of all Gaussians at each pixel, (1, H, W), and what sums such a map under each Gaussian, (N,)."""
    ones = torch.ones_like(gaussians.colors[:, :1]).requires_grad_()
    with torch.enable_grad():
        total = render_draft(gaussians._replace(colors=ones), image, config)
    # the render is linear in the colours: its gradient has the sums
    return total.detach(), lambda weights: torch.autograd.grad(total, ones, weights, retain_graph=True)[0][:, 0]


def region_positions(gaussians: Gaussians, image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the region of each Gaussian, (N,), and of each pixel, (H, W), as positions in the map's ids."""
    ids, regions = gaussians.region_ids, gaussians.regions
    if regions is None or ids is None:
        return torch.zeros_like(gaussians.means[:, 0], dtype=torch.int64), torch.zeros_like(image[0], dtype=torch.int64)
    return regions.index_of(ids), regions.index_of(regions.labels)
