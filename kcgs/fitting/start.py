"""The start of a fit: the map to render with, and the first Gaussians."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from kcgs.functional import RegionMap, choose_widths, edge_band
from kcgs.functional.merging import pairs_to_merge
from kcgs.nn import GaussianField

from .config import FitConfig
from .objective import make_objective
from .optimizers import FrameAdam, GaussianImageAdan, GaussianOptimizer, ImageGSAdam
from .sampling import sample_pixels, spread_repeats
from .state import FitState

# share of an image's values that are 0 or 1, from which on Gaussians that overshoot them are of use
_SATURATED = 0.25
# share of the gradient in the density of Image-GS's centres; the rest is uniform
_GRADIENT_SHARE = 0.7
# Gaussians of half the spacing add up to this
_OVERLAP = math.pi / 2
# cutoff of most of a fit, where it is above the config's, for our optimizer
_DRAFT_CUTOFF = 1e-3
# thinner than this, in pixels, a Gaussian would fall between the pixel centres
_LEAST_SIGMA = 0.5


def start(
    image: Tensor, regions: RegionMap | None, num_gaussians: int, config: FitConfig, seed: int, started: float
) -> FitState:
    """Return the state of a fit at its start; see :func:`kcgs.fit`."""
    band = None if regions is None else edge_band(regions.labels).flatten().nonzero().flatten()
    fitting = _as_many_as_gaussians(image, regions, num_gaussians, config)
    saturated = float(((image == 0.0) | (image == 1.0)).float().mean())
    rendered = _regions_to_render(image, fitting, config)
    field, sigma = first_field(image, num_gaussians, rendered, config, seed)
    return FitState(
        image,
        config,
        num_gaussians,
        seed,
        started,
        clamp=saturated >= _SATURATED if config.clamp == "auto" else config.clamp,
        band=None if band is None or not len(band) else band,
        given=regions,
        objective=make_objective(config.objective, image),
        cutoff=draft_cutoff(config),
        regions=rendered,
        region_ids=field.region_ids,
        optimizer=make_optimizer(config, field, sigma),
        anchor=None if rendered is None else rendered.labels,
        first=field.num_gaussians,
        wanted=field.num_gaussians,
    )


def draft_cutoff(config: FitConfig) -> float:
    """Return the cutoff of the first 85 % of a fit."""
    return max(config.cutoff, _DRAFT_CUTOFF) if config.optimizer == "frame" else config.cutoff


def _as_many_as_gaussians(
    image: Tensor, regions: RegionMap | None, num_gaussians: int, config: FitConfig
) -> RegionMap | None:
    """Merge regions, where the config lets them merge, until each can have a Gaussian: others would be black."""
    if regions is None or not config.merge_regions or regions.num_regions <= num_gaussians:
        return regions
    return regions.merge(pairs_to_merge(image, regions.labels, num_gaussians))[0]


def make_optimizer(config: FitConfig, field: GaussianField, sigma: float) -> GaussianOptimizer:
    """Return what moves Gaussians that are about `sigma` pixels wide."""
    if config.optimizer == "adan":
        return GaussianImageAdan(field, sigma, config.usual_iterations, config.learning_rate_factor)
    if config.optimizer == "frame":
        return FrameAdam(field, config.learning_rate_factor)
    return ImageGSAdam(field, config.learning_rate_factor)


def _regions_to_render(image: Tensor, regions: RegionMap | None, config: FitConfig) -> RegionMap | None:
    if regions is None or not config.guidance or regions.num_regions == 1:
        return None
    # a map that comes with widths says how sharp it is
    if regions.softness != 0.0 or config.softness == 0.0:
        return regions
    if config.softness != "auto":
        return RegionMap.from_labels(regions.labels, config.softness)
    return RegionMap.from_labels(regions.labels, choose_widths(image, regions.labels))


def first_field(
    image: Tensor, num_gaussians: int, regions: RegionMap | None, config: FitConfig, seed: int
) -> tuple[GaussianField, float]:
    """Return the first of N Gaussians and about how wide they are; every region has one, where there are enough."""
    first = math.ceil(config.densify_from * num_gaussians)
    count = min(num_gaussians, max(1 if regions is None else regions.num_regions, first))
    sigma = max(1.0, 0.5 * math.sqrt(image[0].numel() / count))
    if config.initializer == "gradient":
        return gradient_field(image, count, regions, seed), sigma
    field = random_field(image, count, sigma, regions, seed)
    if config.initializer == "uniform":
        x, y = field.means.detach().long().unbind(-1)
        field.colors.data = image[:, y, x].T / _OVERLAP
    return field, sigma


def random_field(
    image: Tensor, num_gaussians: int, sigma: float, regions: RegionMap | None, seed: int
) -> GaussianField:
    """Scatter round Gaussians uniformly over the image; no region starts empty while another has two."""
    size = (image.shape[1], image.shape[2])
    field = GaussianField.random(
        num_gaussians, size, channels=image.shape[0], sigma=sigma, seed=seed, dtype=image.dtype
    ).to(image.device)
    if regions is None:
        return field
    field.assign_regions(regions)
    with torch.no_grad():
        _fill_empty_regions(field, regions, seed)
    return field.assign_regions(regions)


def _fill_empty_regions(field: GaussianField, regions: RegionMap, seed: int) -> None:
    """Move Gaussians from the regions with most into those with none, the largest first, to a random pixel there."""
    assert field.region_ids is not None
    generator = torch.Generator().manual_seed(seed)
    index = regions.index_of(field.region_ids)
    counts = index.bincount(minlength=regions.num_regions)
    areas = regions.index_of(regions.labels.flatten()).bincount(minlength=regions.num_regions)
    empty = [r for r in areas.argsort(descending=True, stable=True).tolist() if counts[r] == 0]
    for region in empty:
        donor = int(counts.argmax())
        if counts[donor] < 2:
            return
        moved = int((index == donor).nonzero()[-1])
        pixels = (regions.labels == regions.ids[region]).nonzero()
        y, x = pixels[int(torch.randint(len(pixels), (1,), generator=generator))].tolist()
        field.means[moved] = field.means.new_tensor([x + 0.5, y + 0.5])
        index[moved] = region
        counts[donor] -= 1
        counts[region] += 1


def gradient_field(image: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int) -> GaussianField:
    """Sample centres where the image changes, as Image-GS does: 0.7 Sobel gradient magnitude + 0.3 uniform."""
    from scipy.ndimage import sobel

    rng = np.random.default_rng(seed)
    planes = image.detach().cpu().double().numpy()
    slope = np.sqrt(sum(sobel(planes, axis) ** 2 for axis in (1, 2)).mean(0)).ravel()
    share = _GRADIENT_SHARE if slope.any() else 0.0
    chance = share * slope / max(slope.sum(), 1e-300) + (1 - share) / slope.size
    pixels = sample_pixels(chance, num_gaussians, rng)
    places = np.stack([pixels % planes.shape[2], pixels // planes.shape[2]], -1) + 0.5
    centres = spread_repeats(places, pixels, rng)
    sigma = np.maximum(0.5 / np.sqrt(num_gaussians * chance[pixels]), _LEAST_SIGMA)
    colors = planes.reshape(len(planes), -1).T[pixels] / _OVERLAP
    cholesky = np.stack([sigma, np.zeros_like(sigma), sigma], -1)
    tensors = (torch.from_numpy(values).to(image) for values in (centres, cholesky, colors))
    field = GaussianField(*tensors, size=(image.shape[1], image.shape[2]))
    return field if regions is None else field.assign_regions(regions)
