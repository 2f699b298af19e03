"""A fit in progress: what is drawn, and what may happen to it."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from kcgs.functional import RegionMap, region_splat
from kcgs.nn import GaussianField

from .assign import refresh_ids
from .config import FitConfig
from .descent import make_descent
from .grow import propose
from .initialize import INITIALIZERS, random_field
from .monitor import FitResult, Gaussians, Monitor, StopReason
from .refine import refine_contours
from .release import helpless_pairs, merge_pairs
from .schedule import Schedule
from .widths import choose_widths

# scales that growth looks for, in pixels
_GROWTH_SIGMAS = (0.7, 1.1, 1.8, 2.9, 4.7, 7.5)


class Session:
    """State of a fit and the moves it can make; `fit` says when."""

    def __init__(
        self, image: Tensor, regions: RegionMap | None, num_gaussians: int, config: FitConfig, seed: int, start: float
    ) -> None:
        self.image, self.given, self.config = image, regions, config
        self.size = (image.shape[1], image.shape[2])
        self.monitor = Monitor(image, regions, start)
        self.drawn = _regions_to_draw(image, regions, config)
        field, sigma = _initialize(image, num_gaussians, self.drawn, config, seed)
        self.ids = field.region_ids
        self.descent = make_descent(config, field, sigma)
        self.schedule = Schedule(config, num_gaussians, len(field))
        self.iteration = 0
        self.grown = 0
        self.released = False
        self.log_every = max(1, config.iterations // config.history_points)

    def progress(self) -> float:
        """Share of the fit that is done."""
        return self.schedule.progress(self.iteration, self.monitor.seconds())

    def gaussians(self) -> Gaussians:
        """Return what is drawn now."""
        return Gaussians(*self.descent.tensors(), self.ids, self.drawn)

    def draw(self) -> Tensor:
        """Draw (C, H, W)."""
        means, cholesky, colors, ids, regions = self.gaussians()
        cutoff, backend = self.config.cutoff, self.config.backend
        picture = region_splat(means, cholesky, colors, ids, regions, size=self.size, cutoff=cutoff, backend=backend)
        return picture.clamp(0.0, 1.0) if self.config.clamp else picture

    def step(self, picture: Tensor, progress: float) -> None:
        """Move the Gaussians downhill."""
        difference = torch.sub(picture.detach(), self.image)
        # the loss's gradient but for a constant, which no descent here feels
        picture.backward(difference.sign_() if self.config.loss == "l1" else difference)
        self.descent.step(self.schedule.rate(progress))
        self.iteration += 1

    def log(self, picture: Tensor) -> None:
        """Measure the picture and write it down."""
        difference = picture.detach() - self.image
        loss = difference.abs().mean() if self.config.loss == "l1" else difference.square().mean()
        self.monitor.log(self.iteration, float(loss), picture, self.gaussians())

    def refresh_ids(self) -> None:
        """Read the ids again under the centres, where the recipe does so and it is time."""
        config = self.config
        every = max(1, round(config.refresh_every * config.iterations))
        if self.drawn is None or not config.warmup or self.iteration % every:
            return
        if 0 < self.iteration <= config.refresh_until * config.iterations:
            self.ids = refresh_ids(self.descent.tensors()[0], self.ids, self.drawn)

    @torch.no_grad()
    def grow(self, progress: float) -> None:
        """Add Gaussians where the error is, after moving the contours, if that is due."""
        due = self.schedule.growth_step(progress)
        if due <= self.grown:
            return
        self.grown = due
        if self.config.refine:
            self.refine()
        residual = self.image - self.draw()
        count = self.schedule.alive(due) - len(self.descent.tensors()[0])
        found = propose(residual, self.drawn, count, sigmas=_GROWTH_SIGMAS)
        self.descent.append(found.means, found.cholesky, found.colors)
        if self.ids is not None and found.region_ids is not None:
            self.ids = torch.cat([self.ids, found.region_ids])

    @torch.no_grad()
    def refine(self) -> None:
        """Move the contours."""
        if self.drawn is None or self.given is None:
            return
        self.drawn = refine_contours(
            self.gaussians().field(self.size),
            self.image,
            self.drawn,
            given=self.given.labels,
            max_distance=None if self.config.max_move == "any" else self.config.max_move,
            length_weight=self.config.contour_price,
            backend=self.config.backend,
        )

    def release(self, progress: float) -> None:
        """Let go, once, the contours that a trial finds no help."""
        if not self.config.release or self.released or progress < self.config.grow_between[1]:
            return
        self.released = True
        if self.drawn is not None and self.ids is not None:
            pairs = helpless_pairs(self)
            self.drawn, self.ids = merge_pairs(self.drawn, self.ids, pairs)

    def finish(self, reason: StopReason) -> FitResult:
        """Measure the last state and return the best."""
        if reason in ("iterations", "callback", "seconds") and self.descent.is_finite():
            with torch.no_grad():
                self.log(self.draw())
        best = self.monitor.best
        assert best is not None
        return FitResult(best.field(self.size), best.regions, self.monitor.history, reason, self.config)

    def state(self) -> dict[str, Any]:
        """Return everything a resumed fit needs."""
        kept = {name: getattr(self, name) for name in ("iteration", "grown", "released", "ids", "drawn")}
        return {**kept, "descent": self.descent.state(), "monitor": self.monitor.state()}

    def load(self, state: dict[str, Any]) -> None:
        """Take up a state."""
        for name in ("iteration", "grown", "released", "ids", "drawn"):
            setattr(self, name, state[name])
        self.descent.load(state["descent"])
        self.monitor.load(state["monitor"])


def _regions_to_draw(image: Tensor, regions: RegionMap | None, config: FitConfig) -> RegionMap | None:
    if regions is None or not config.guidance or regions.num_regions == 1:
        return None
    # a map that comes with widths, or with sub-pixel coverage, says how sharp it is
    if regions.softness != 0.0 or regions.supersample > 1 or config.softness == 0.0:
        return regions
    softness = choose_widths(image, regions.labels) if config.softness == "auto" else config.softness
    return RegionMap.from_labels(regions.labels, softness)


def _initialize(
    image: Tensor, num_gaussians: int, drawn: RegionMap | None, config: FitConfig, seed: int
) -> tuple[GaussianField, float]:
    least = 1 if drawn is None else drawn.num_regions
    count = min(num_gaussians, max(least, math.ceil(config.grow_from * num_gaussians)))
    sigma = config.init_sigma or max(1.0, 0.5 * math.sqrt(image.shape[1] * image.shape[2] / count))
    if config.initializer == "random":
        return random_field(image, count, sigma, drawn, seed), sigma
    return INITIALIZERS[config.initializer](image, count, drawn, seed), sigma
