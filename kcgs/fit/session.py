"""A fit in progress: what is drawn, and what may happen to it."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch
from torch import Tensor

from kcgs.functional import RegionMap, choose_widths, region_splat, smooth_contours
from kcgs.nn import GaussianField
from kcgs.pruning import PruneResult, prune
from kcgs.scene import Scene

from .assign import refresh_ids
from .config import FitConfig
from .descent import make_descent
from .grow import propose
from .initialize import INITIALIZERS, random_field
from .monitor import FitResult, Gaussians, Monitor, StopReason
from .polish import is_flat, polish
from .refine import accept_moves, refine_contours
from .release import choose_contours, release
from .schedule import DENSIFY_END, make_schedule

# share of its pixels that a region must keep when contours are smoothed
_LEAST_AREA = 0.7
# of smoothed contours
_SUPERSAMPLE = 4
# how often contours move after growth, and then only where that helps at once
_SETTLINGS = 4
# share of the seconds that a fit may spend on moving contours
_REFINEMENT_SHARE = 0.1
# share of the seconds that a fit may have used and still try out its contours at the start: that starts it twice more
_START_SHARE = 0.03
# what the later trial costs, in iterations, and the share of the seconds that it may take
_TRIAL_ITERATIONS, _TRIAL_SHARE = 60, 0.1
# a fit to a target starts with a Gaussian for each square of so many pixels
_TARGET_SPACING = 64
_DRAFTS_END = 0.85
_KEPT = ("iteration", "cutoff", "wanted", "additions", "settlings", "released", "ids", "drawn", "anchor")
# contours move before every second addition, and every fourth time their widths are chosen anew
_ADDITIONS_A_REFINEMENT = 2
_ADDITIONS_A_CHOICE = 4
# where the clock ends the fit, descent gets this many times the seconds of the growth before it
_GROWTH_PATIENCE = 2.0
# scales that growth looks for, in pixels
_GROWTH_SIGMAS = (0.7, 1.1, 1.8, 2.9, 4.7, 7.5)


# about how many entries the history gets
_HISTORY_POINTS = 100
# fractions of the iterations: between refreshes of the region ids, and their end
_REFRESH_EVERY, _REFRESH_UNTIL = 0.02, 0.5
# share of a picture's values that are 0 or 1, from which on Gaussians that overshoot them are of use
_SATURATED = 0.25


class Session:
    """State of a fit and the moves it can make; `fit` says when."""

    def __init__(
        self, image: Tensor, regions: RegionMap | None, num_gaussians: int, config: FitConfig, seed: int, start: float
    ) -> None:
        self.image, self.config = image, config
        self.size = (image.shape[1], image.shape[2])
        self.clamps = _is_saturated(image) if config.clamp == "auto" else config.clamp
        self.monitor = Monitor(image, regions, start)
        self.seed, self.num_gaussians = seed, num_gaussians
        self.cutoff = max(config.cutoff, config.draft_cutoff if config.target_psnr is None else 0.0)
        self.begin(_regions_to_draw(image, regions, num_gaussians, config))
        # a map that came with widths keeps them
        self.chooses_widths = config.softness == "auto" and regions is not None and regions.softness == 0.0
        in_time = self.monitor.seconds() < _START_SHARE * (config.max_seconds or math.inf)
        if config.merge_regions and self.drawn is not None and self.drawn.supersample == 1 and in_time:
            choose_contours(self)
        if self.drawn is not None and self.drawn.num_regions > num_gaussians:
            _warn_of_empty_regions(self.drawn.num_regions, num_gaussians)

    def begin(self, drawn: RegionMap | None) -> None:
        """Start with these regions."""
        self.drawn = drawn
        # where contours may not move far from
        self.anchor = drawn.labels if drawn is not None else torch.zeros(0, dtype=torch.long)
        field, sigma = _initialize(self.image, self.num_gaussians, drawn, self.config, self.seed)
        self.ids = field.region_ids
        self.descent = make_descent(self.config, field, sigma)
        self.schedule = make_schedule(self.config, self.num_gaussians, len(field))
        self.wanted = len(field)
        self.iteration = self.additions = self.settlings = 0
        self.released = False
        self.grow_after = self.refining = 0.0

    def progress(self) -> float:
        """Share of the fit that is done."""
        return self.schedule.progress(self.iteration, self.monitor.seconds())

    def gaussians(self) -> Gaussians:
        """Return what is drawn now."""
        return Gaussians(*self.descent.tensors(), self.ids, self.drawn)

    def sharpen(self, progress: float) -> None:
        """Draw with the cutoff of the result from here on, once drafts have served their time."""
        if self.cutoff != self.config.cutoff and progress >= _DRAFTS_END:
            self.cutoff = self.config.cutoff
            # what was measured on drafts does not compare
            self.monitor.forget_best()

    def draw(self, gaussians: Gaussians | None = None) -> Tensor:
        """Draw (C, H, W): these Gaussians, or those of the moment."""
        means, cholesky, colors, ids, regions = gaussians or self.gaussians()
        cutoff, backend = self.cutoff, self.config.backend
        picture = region_splat(means, cholesky, colors, ids, regions, size=self.size, cutoff=cutoff, backend=backend)
        return picture.clamp(0.0, 1.0) if self.clamps else picture

    def step(self, picture: Tensor, progress: float) -> None:
        """Move the Gaussians downhill."""
        difference = torch.sub(picture.detach(), self.image)
        # the loss's gradient but for a constant, which no descent here feels
        picture.backward(difference.sign_() if self.config.loss == "l1" else difference)
        self.descent.step(self.schedule.rate(progress))
        self.iteration += 1

    def log_is_due(self, progress: float) -> bool:
        """Say whether the history wants an entry: about 100 over the fit, by iterations or by the clock."""
        if self.config.target_psnr is not None and self.iteration % max(1, self.config.iterations // 100) == 0:
            return True  # the search for a target goes by what is measured
        if self.config.max_seconds is None:
            return self.iteration % max(1, self.config.iterations // _HISTORY_POINTS) == 0
        return progress * _HISTORY_POINTS >= len(self.monitor.history)

    def log(self, picture: Tensor, gaussians: Gaussians | None = None) -> None:
        """Measure the picture of these Gaussians, or of those of the moment, and write it down."""
        difference = picture.detach() - self.image
        loss = difference.abs().mean() if self.config.loss == "l1" else difference.square().mean()
        self.monitor.log(self.iteration, float(loss), picture, gaussians or self.gaussians())
        self.schedule.observe(self.progress(), self.monitor.history[-1].psnr)

    def refresh_ids(self) -> None:
        """Read the ids again under the centres, where the recipe does so and it is time."""
        config = self.config
        every = max(1, round(_REFRESH_EVERY * config.iterations))
        if self.drawn is None or not config.warmup or self.iteration % every:
            return
        if 0 < self.iteration <= _REFRESH_UNTIL * config.iterations:
            self.ids = refresh_ids(self.descent.tensors()[0], self.ids, self.drawn)

    @torch.no_grad()
    def grow(self, progress: float) -> None:
        """Add Gaussians where the error is, after moving the contours, if that is due."""
        end = DENSIFY_END
        wanted = self.schedule.wanted(progress)
        start = self.monitor.seconds()
        # against the clock, growth must leave time for the descent
        if wanted <= self.wanted or (self.config.max_seconds and start < self.grow_after and progress < 0.9 * end):
            return
        self.wanted = wanted
        self.additions += 1
        if self.additions % _ADDITIONS_A_REFINEMENT == 0:
            self.refine(
                self.config.contour_rise, choose=self.additions % _ADDITIONS_A_CHOICE == _ADDITIONS_A_REFINEMENT
            )
        residual = self.image - self.draw()
        count = wanted - len(self.descent.tensors()[0])
        found = propose(residual, self.drawn, count, sigmas=_GROWTH_SIGMAS, backend=self.config.backend)
        self.descent.append(found.means, found.cholesky, found.colors)
        if self.ids is not None and found.region_ids is not None:
            self.ids = torch.cat([self.ids, found.region_ids])
        self.grow_after = self.monitor.seconds() + _GROWTH_PATIENCE * (self.monitor.seconds() - start)

    def settle(self, progress: float) -> None:
        """Move the contours after growth, if that is due."""
        end = DENSIFY_END
        if progress >= end + (1 - end) * (self.settlings + 1) / (_SETTLINGS + 1) and self.settlings < _SETTLINGS:
            self.settlings += 1
            self.refine(1.0)

    @torch.no_grad()
    def refine(self, largest_rise: float, choose: bool = False) -> None:
        """Move the contours where that raises the squared error about them by no more than this factor."""
        config, before, start = self.config, self.drawn, self.monitor.seconds()
        if not config.move_contours or before is None or before.supersample > 1:
            return
        if self.refining > _REFINEMENT_SHARE * (config.max_seconds or math.inf):
            return
        moved = refine_contours(
            self.gaussians().field(self.size),
            self.image,
            before,
            given=self.anchor,
            max_distance=None if config.max_move == "any" else config.max_move,
            length_weight=config.contour_cost,
            backend=config.backend,
        )
        if moved is not before:
            gain = largest_rise * self.error() - self.error(self.gaussians()._replace(regions=moved))
            moved = accept_moves(before, moved, gain)
        if choose and self.chooses_widths:
            moved = RegionMap.from_labels(moved.labels, choose_widths(self.image, moved.labels))
        self.drawn = moved
        self.refining += self.monitor.seconds() - start

    def error(self, gaussians: Gaussians | None = None) -> Tensor:
        """Squared error of each pixel, (H, W), channels averaged."""
        return (self.draw(gaussians).detach() - self.image).square().mean(0)

    def release(self, progress: float) -> None:
        """Let go, once, the contours that a trial finds no help."""
        if not self.config.merge_regions or self.released or progress < DENSIFY_END:
            return
        self.released = True
        cost = _TRIAL_ITERATIONS * self.monitor.seconds() / max(1, self.iteration)
        in_time = cost < _TRIAL_SHARE * (self.config.max_seconds or math.inf)
        if self.drawn is not None and self.ids is not None and self.drawn.supersample == 1 and in_time:
            release(self)

    def finish(self, reason: StopReason) -> FitResult:
        """Measure the last state and return the best."""
        drafted = self.monitor.best if self.cutoff != self.config.cutoff else None
        self.sharpen(1.0)
        with torch.no_grad():
            if drafted is not None:
                self.log(self.draw(drafted), drafted)
            if reason != "diverged" and self.descent.is_finite():
                self.log(self.draw())
        best = self.monitor.best
        assert best is not None
        field, regions, config = best.field(self.size), best.regions, self.config
        if config.refine_flat and reason == "iterations" and is_flat(self.image, regions, len(field)):
            field = self._polished(field, regions)
        left = PruneResult(Scene(field, regions), 0, 0.0)
        if config.prune > 0:
            left = prune(left.scene, config.prune, cutoff=config.cutoff, backend=config.backend)
        return FitResult(left.scene.field, regions, self.monitor.history, reason, config, left.removed, left.change)

    def _polished(self, field: GaussianField, regions: RegionMap | None) -> GaussianField:
        """Take a flat scene to its last digits, and write them down."""
        config = self.config
        left = math.inf if config.max_seconds is None else max(0.01, config.max_seconds - self.monitor.seconds())
        polished = polish(field, self.image, regions, max_seconds=left, cutoff=config.cutoff, backend=config.backend)
        means, cholesky, colors = (t.detach() for t in (polished.means, polished.cholesky, polished.colors))
        gaussians = Gaussians(means, cholesky, colors, polished.region_ids, regions)
        with torch.no_grad():
            self.log(self.draw(gaussians), gaussians)
        return polished

    def state(self) -> dict[str, Any]:
        """Return everything a resumed fit needs."""
        kept = {name: getattr(self, name) for name in _KEPT}
        parts = {name: getattr(self, name).state() for name in ("descent", "monitor", "schedule")}
        return {**kept, **parts}

    def load(self, state: dict[str, Any]) -> None:
        """Take up a state."""
        for name in _KEPT:
            setattr(self, name, state[name])
        for name in ("descent", "monitor", "schedule"):
            getattr(self, name).load(state[name])


def _is_saturated(image: Tensor) -> bool:
    return bool(((image == 0.0) | (image == 1.0)).float().mean() >= _SATURATED)


def _regions_to_draw(
    image: Tensor, regions: RegionMap | None, num_gaussians: int, config: FitConfig
) -> RegionMap | None:
    if regions is None or not config.guidance or regions.num_regions == 1:
        return None
    # a map that comes with widths, or with sub-pixel coverage, says how sharp it is
    if regions.softness != 0.0 or regions.supersample > 1 or config.softness == 0.0:
        return regions
    if config.softness != "auto":
        return RegionMap.from_labels(regions.labels, config.softness)
    widths = choose_widths(image, regions.labels)
    if config.refine_flat and config.move_contours and any(widths.values()) and is_flat(image, regions, num_gaussians):
        # a chart's edges are smooth curves: their coverage says more than a blur
        smooth = RegionMap.from_labels(smooth_contours(regions.labels, _SUPERSAMPLE), supersample=_SUPERSAMPLE)
        if _keeps_areas(regions, smooth):
            return smooth
    return RegionMap.from_labels(regions.labels, widths)


def _initialize(
    image: Tensor, num_gaussians: int, drawn: RegionMap | None, config: FitConfig, seed: int
) -> tuple[GaussianField, float]:
    least = 1 if drawn is None else drawn.num_regions
    first = math.ceil(config.densify_from * num_gaussians)
    if config.target_psnr is not None and config.densify_from < 1.0:
        # num_gaussians is the most there may be, and says nothing of how many are needed
        first = min(first, math.ceil(image.shape[1] * image.shape[2] / _TARGET_SPACING**2))
    count = min(num_gaussians, max(least, first))
    sigma = max(1.0, 0.5 * math.sqrt(image.shape[1] * image.shape[2] / count))
    if config.initializer == "random":
        return random_field(image, count, sigma, drawn, seed), sigma
    return INITIALIZERS[config.initializer](image, count, drawn, seed, config.backend), sigma


def _warn_of_empty_regions(regions: int, num_gaussians: int) -> None:
    warnings.warn(
        f"{regions - num_gaussians} of {regions} regions get no Gaussian and stay black: num_gaussians is "
        f"{num_gaussians}; merge regions or take more",
        stacklevel=6,  # past the session and the decorators of `fit`
    )


def _keeps_areas(regions: RegionMap, smooth: RegionMap) -> bool:
    """Say whether smooth contours leave every region, thin ones too, most of its pixels."""
    count = regions.num_regions
    before = regions.index_of(regions.labels).flatten().bincount(minlength=count)
    own = regions.index_of(smooth.labels).flatten()
    return bool((own.bincount(minlength=count) >= _LEAST_AREA * before).all())
