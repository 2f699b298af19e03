"""The fit: initialize, then render, loss, step, refresh, log, until something says stop."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_image
from kcgs.functional import RegionMap, edge_band, region_splat
from kcgs.nn import GaussianField

from .adan import Adan
from .assign import refresh_ids
from .config import FitConfig
from .initialize import random_field
from .parameters import RawParameters

StopReason = Literal["iterations", "seconds", "target_psnr", "callback", "diverged"]


class HistoryEntry(NamedTuple):
    """One point of the curve of error against run time."""

    iteration: int
    seconds: float
    loss: float
    psnr: float
    ef_psnr: float
    num_gaussians: int


class FitResult(NamedTuple):
    """What a fit gives back.

    `regions` is what the field must be drawn with: None where the recipe confines nothing.
    """

    field: GaussianField
    regions: RegionMap | None
    history: list[HistoryEntry]
    stop_reason: StopReason
    config: FitConfig


@torch.inference_mode(False)
@torch.enable_grad()
def fit(
    image: Tensor,
    regions: RegionMap | Tensor | None = None,
    num_gaussians: int = 1000,
    *,
    recipe: str = "paper",
    seed: int = 0,
    config: FitConfig | None = None,
    on_step: Callable[[int, HistoryEntry], bool | None] | None = None,
) -> FitResult:
    r"""Fit a field of Gaussians to an image.

    Convention: the same arguments, device and number of threads give the same field, bit for bit (unless it is stopped
    by the clock). The best state that was logged is returned, not the last.

    Args:
        image: :math:`(C, H, W)` or :math:`(1, C, H, W)`, floating, values in [0, 1].
        regions: label map of the image's size, or a RegionMap; also says where EF-PSNR is measured. None: one region.
        num_gaussians: N, at least 1.
        recipe: a name from :func:`available_recipes`; not read where `config` is given.
        seed: of the random start.
        config: all settings.
        on_step: called after every iteration with its number (from 1) and the last history entry; returning True
            stops the fit.

    Returns:
        Field, regions to draw it with, history, why it stopped, and the settings.

    Raises:
        TypeError: wrong types.
        ValueError: an image that is not finite or not in [0, 1], regions of another size, N below 1, unknown recipe.

    Example:
        >>> image = torch.zeros(3, 16, 24)
        >>> image[:, :, 12:] = 1.0
        >>> config = FitConfig.from_recipe("paper", iterations=200)
        >>> result = fit(image, (image[0] > 0.5).long(), num_gaussians=4, config=config)
        >>> result.history[-1].psnr > 20
        True
    """
    config = FitConfig.from_recipe(recipe) if config is None else config
    start = time.perf_counter()
    image, regions = _check_problem(image, regions, num_gaussians)
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise ValueError(f"seed must be an integer in [0, 2**63); got {seed!r}")
    drawn = _regions_to_draw(regions, config)
    monitor = _Monitor(image, regions, start)

    sigma = config.init_sigma or max(1.0, 0.5 * math.sqrt(image.shape[1] * image.shape[2] / num_gaussians))
    field = random_field(image, num_gaussians, sigma, drawn, seed)
    raw = RawParameters(field)
    optimizer = _make_optimizer(config, raw, sigma)
    rates = [group["lr"] for group in optimizer.param_groups]
    ids = field.region_ids
    log_every = max(1, config.iterations // config.history_points)
    refresh_every = max(1, round(config.refresh_every * config.iterations))
    reason: StopReason = "iterations"

    for iteration in range(config.iterations):
        done = max(iteration / config.iterations, monitor.seconds() / (config.max_seconds or math.inf))
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * config.decay ** int(done / config.decay_every)

        if not raw.is_finite():
            warnings.warn(f"the fit diverged at iteration {iteration}: the best state so far is kept", stacklevel=2)
            reason = "diverged"
            break
        means, cholesky, colors = raw.tensors()
        if drawn is not None and config.warmup and 0 < iteration <= config.refresh_until * config.iterations:
            ids = refresh_ids(means, ids, drawn) if iteration % refresh_every == 0 else ids
        picture = _draw(means, cholesky, colors, ids, drawn, image, config)
        loss = _loss(picture, image, config)
        if iteration % log_every == 0:
            monitor.log(iteration, loss, picture, means, cholesky, colors, ids)
            if monitor.best_psnr >= (config.target_psnr or math.inf):
                reason = "target_psnr"
                break
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

        if on_step is not None and on_step(iteration + 1, monitor.history[-1]):
            reason = "callback"
            break
        if monitor.seconds() >= (config.max_seconds or math.inf):
            reason = "seconds"
            break

    if reason in ("iterations", "callback", "seconds") and raw.is_finite():
        with torch.no_grad():
            means, cholesky, colors = raw.tensors()
            picture = _draw(means, cholesky, colors, ids, drawn, image, config)
            monitor.log(iteration + 1, _loss(picture, image, config), picture, means, cholesky, colors, ids)
    return FitResult(monitor.best_field(), drawn, monitor.history, reason, config)


def _check_problem(
    image: Tensor, regions: RegionMap | Tensor | None, num_gaussians: int
) -> tuple[Tensor, RegionMap | None]:
    image = check_image("image", image)
    if image.ndim == 4:
        if image.shape[0] != 1:
            raise ValueError(f"image must be one image, (C, H, W) or (1, C, H, W); got {tuple(image.shape)}")
        image = image[0]
    if image.min() < 0 or image.max() > 1:
        raise ValueError(f"image must be in [0, 1]; got [{float(image.min()):g}, {float(image.max()):g}]")
    if isinstance(num_gaussians, bool) or not isinstance(num_gaussians, int):
        raise TypeError(f"num_gaussians must be an integer; got {num_gaussians!r}")
    if num_gaussians < 1:
        raise ValueError(f"num_gaussians must be at least 1; got {num_gaussians}")
    if isinstance(regions, Tensor):
        regions = RegionMap.from_labels(regions)
    if regions is not None:
        if not isinstance(regions, RegionMap):
            raise TypeError(f"regions must be a RegionMap, a label map Tensor or None; got {type(regions).__name__}")
        if regions.size != tuple(image.shape[1:]) or regions.labels.ndim != 2:
            raise ValueError(
                f"regions must be one map of the image's size {tuple(image.shape[1:])}; got "
                f"{tuple(regions.labels.shape)}"
            )
        regions = regions.to(image.device)
    dtype = torch.float64 if image.dtype == torch.float64 else torch.float32
    # a copy: an inference tensor cannot take part in a graph
    return image.detach().to(dtype, copy=True), regions


def _regions_to_draw(regions: RegionMap | None, config: FitConfig) -> RegionMap | None:
    if regions is None or not config.guidance or regions.num_regions == 1:
        return None
    softness = config.softness or regions.softness
    return regions if softness == regions.softness else RegionMap.from_labels(regions.labels, softness)


def _make_optimizer(config: FitConfig, raw: RawParameters, sigma: float) -> torch.optim.Optimizer:
    groups = raw.groups(config.effective_learning_rate(), sigma)
    return Adan(groups) if config.optimizer == "adan" else torch.optim.Adam(groups)


def _draw(
    means: Tensor,
    cholesky: Tensor,
    colors: Tensor,
    ids: Tensor | None,
    drawn: RegionMap | None,
    image: Tensor,
    config: FitConfig,
) -> Tensor:
    size = (image.shape[1], image.shape[2])
    picture = region_splat(means, cholesky, colors, ids, drawn, size=size, cutoff=config.cutoff, backend=config.backend)
    return picture.clamp(0.0, 1.0) if config.clamp else picture


def _loss(picture: Tensor, image: Tensor, config: FitConfig) -> Tensor:
    difference = picture - image
    return difference.abs().mean() if config.loss == "l1" else difference.square().mean()


class _Monitor:
    """Clock, history and best state of a fit."""

    def __init__(self, image: Tensor, regions: RegionMap | None, start: float) -> None:
        self.image = image
        self.start = start
        self.history: list[HistoryEntry] = []
        self.best_psnr = -math.inf
        self._best: tuple[Tensor | None, ...] = ()
        band = edge_band(regions.labels) if regions is not None else None
        self.band = band if band is not None and bool(band.any()) else None

    def seconds(self) -> float:
        return time.perf_counter() - self.start

    def log(
        self,
        iteration: int,
        loss: Tensor,
        picture: Tensor,
        means: Tensor,
        cholesky: Tensor,
        colors: Tensor,
        ids: Tensor | None,
    ) -> None:
        error = (picture.detach().clamp(0.0, 1.0) - self.image).square()
        psnr = _decibel(float(error.mean()))
        ef_psnr = _decibel(float(error[:, self.band].mean())) if self.band is not None else math.nan
        entry = HistoryEntry(iteration, self.seconds(), float(loss.detach()), psnr, ef_psnr, len(means))
        self.history.append(entry)
        if psnr > self.best_psnr:
            self.best_psnr = psnr
            self._best = tuple(None if t is None else t.detach().clone() for t in (means, cholesky, colors, ids))

    def best_field(self) -> GaussianField:
        means, cholesky, colors, ids = self._best
        assert means is not None and cholesky is not None and colors is not None
        return GaussianField(means, cholesky, colors, ids, size=(self.image.shape[1], self.image.shape[2]))


def _decibel(mean_square: float) -> float:
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
