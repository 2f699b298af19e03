"""Where the Gaussians start."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.functional import RegionMap, region_splat
from kcgs.nn import GaussianField

Array = NDArray[np.floating]
Indices = NDArray[np.int64]

# the share of the gradient in the density of centres; the rest is uniform
_GRADIENT_SHARE = 0.7
_GRADIENT_POWER = 1.3
_ROUNDS = 4
# pixels a cell that the rounds and the cells' moments are computed from, and at least a region
_PIXELS_A_CELL = (16, 48)
_PIXELS_A_REGION = 2000
# standard deviation of a Gaussian over that of its cell: 0.5 sqrt(area) for a square
_SPREAD = math.sqrt(3.0)
_LEAST_SIGMA = 0.5
_COLOR_STEPS = 8


def random_field(
    image: Tensor, num_gaussians: int, sigma: float, regions: RegionMap | None, seed: int
) -> GaussianField:
    """Scatter round Gaussians uniformly over the image; no region starts empty while another has two.

    Args:
        image: (C, H, W); gives size, channels, dtype and device.
        num_gaussians: N.
        sigma: standard deviation in pixels.
        regions: the map whose ids they get; None: none.
        seed: of the draw.
    """
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
    # a region may have no pixel of its own, with a map finer than the image
    empty = [r for r in areas.argsort(descending=True, stable=True).tolist() if counts[r] == 0 and areas[r] > 0]
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


def sampled_field(
    image: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int, backend: str = "auto"
) -> GaussianField:
    """Draw centres where the image changes: with probability 0.7 x gradient magnitude + 0.3 x uniform.

    Round Gaussians of half the expected spacing, coloured like the pixel under them, so scaled that their sum is
    about the image. Pixels are drawn without replacement while there are as many as Gaussians.

    Args:
        image: (C, H, W); gives size, channels, dtype and device.
        num_gaussians: N, at least 1.
        regions: the map whose ids they get; None: none.
        seed: of the draw.
        backend: kernel that colours are solved with.

    Example:
        >>> image = torch.zeros(1, 20, 40)
        >>> image[:, :, 20:] = 1.0
        >>> field = sampled_field(image, 50, None, seed=0)
        >>> bool(((field.means[:, 0] - 20).abs() < 2).float().mean() > 0.4)
        True
    """
    rng = np.random.default_rng(seed)
    planes = image.detach().cpu().double().numpy()
    slope = _slope(planes, np.zeros(planes.shape[1:], dtype=np.int64)).ravel()
    total = slope.sum()
    share = _GRADIENT_SHARE if total > 0 else 0.0
    chance = share * slope / max(total, 1e-300) + (1 - share) / slope.size
    pixels = _draw(chance, num_gaussians, rng)
    x, y = pixels % planes.shape[2], pixels // planes.shape[2]
    centres = _spread_repeats(np.stack([x, y], -1) + 0.5, pixels, rng)
    sigma = np.maximum(0.5 / np.sqrt(num_gaussians * chance[pixels]), _LEAST_SIGMA)
    # Gaussians of half the spacing add up to pi / 2
    shades = planes.reshape(len(planes), -1).T[pixels] / (math.pi / 2)
    cholesky = np.stack([sigma, np.zeros_like(sigma), sigma], -1)
    field = _field(image, centres, cholesky, shades)
    return field if regions is None else field.assign_regions(regions)


def kmeans_field(
    image: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int, backend: str = "auto"
) -> GaussianField:
    """Cut every region into cells of equal density mass by k-means; one Gaussian a cell, of its shape and colour.

    The density of a pixel is 0.7 x (gradient inside its region / mean gradient)^1.3 + 0.3: detail attracts cells, the
    contour itself does not. A region gets Gaussians in proportion to its mass and at least one; with fewer Gaussians
    than regions the regions of largest mass get one each, and the others stay black.

    Args:
        image: (C, H, W); gives size, channels, dtype and device.
        num_gaussians: N, at least 1.
        regions: the map; None: one region, and no ids.
        seed: of the draw of the first centres and of the pixels that the cells are computed from.
        backend: kernel that colours are solved with.

    Example:
        >>> labels = torch.zeros(16, 24, dtype=torch.long)
        >>> labels[4:8, 4:8] = 7
        >>> field = kmeans_field(torch.rand(3, 16, 24), 20, RegionMap.from_labels(labels), seed=0)
        >>> sorted(set(field.region_ids.tolist())), len(field)
        ([0, 7], 20)
    """
    rng = np.random.default_rng(seed)
    planes = image.detach().cpu().double().numpy()
    size = planes.shape[1:]
    index, count = _region_index(size, regions)
    density = _density(planes, index)
    mass = np.bincount(index.ravel(), density.ravel(), minlength=count).astype(np.float64)
    budget = np.zeros(count, np.int64)
    # a region may have no pixel of its own, with a map finer than the image
    budget[mass > 0] = _budget(mass[mass > 0], num_gaussians)
    # pixels sorted by region, raster order within
    order = np.argsort(index, axis=None, kind="stable")
    ends = np.bincount(index.ravel(), minlength=count).cumsum()
    values = planes.reshape(len(planes), -1).T
    parts = []
    for region in np.flatnonzero(budget):
        pixels = order[ends[region - 1] if region else 0 : ends[region]]
        parts.append(_cells(pixels, density.ravel()[pixels], values, size[1], int(budget[region]), rng))
    centres, cholesky, colors = (np.concatenate(values) for values in zip(*parts, strict=True))
    field = _field(image, centres, cholesky, colors)
    if regions is not None:
        field.region_ids = regions.ids[torch.from_numpy(np.repeat(np.arange(len(budget)), budget)).to(image.device)]
    return _solve_colors(field, image, regions, backend)


def gaussian_shares(image: Tensor, regions: RegionMap) -> Tensor:
    """Share of the Gaussians that `kmeans_field` gives every region, the rounding to whole ones left aside.

    Args:
        image: (C, H, W) floating.
        regions: the map, R regions.

    Returns:
        (R,) float64 on the CPU in the order of the map's ids; they sum to 1.

    Example:
        >>> labels = torch.zeros(16, 24, dtype=torch.long)
        >>> labels[:, 18:] = 7
        >>> gaussian_shares(torch.zeros(3, 16, 24), RegionMap.from_labels(labels))
        tensor([0.7500, 0.2500], dtype=torch.float64)
    """
    planes = image.detach().cpu().double().numpy()
    index, count = _region_index(planes.shape[1:], regions)
    mass = np.bincount(index.ravel(), _density(planes, index).ravel(), minlength=count)
    return torch.from_numpy(mass / mass.sum())


def _region_index(size: tuple[int, ...], regions: RegionMap | None) -> tuple[Indices, int]:
    """Place of every pixel's region in the map's ids, (H, W), and the number of regions."""
    if regions is None:
        return np.zeros(size, np.int64), 1
    return regions.membership.index[0].cpu().numpy().astype(np.int64), regions.num_regions


def _density(planes: Array, index: Indices) -> Array:
    """Density of the cells' centres, (H, W)."""
    slope = _slope(planes, index)
    density = np.full(index.shape, 1.0 - _GRADIENT_SHARE)
    if slope.any():
        density += _GRADIENT_SHARE * (slope / slope.mean()) ** _GRADIENT_POWER
    return density


def _slope(planes: Array, index: Indices) -> Array:
    """Root mean square difference to the neighbours of the same region, over channels, (H, W)."""
    total, count = np.zeros(index.shape), np.zeros(index.shape)
    for axis in (0, 1):
        here = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        there = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        same = index[here] == index[there]
        difference = np.square(np.diff(planes, axis=axis + 1)).sum(0) * same
        for side in (here, there):
            total[side] += difference
            count[side] += same
    return np.sqrt(total / np.maximum(count, 1))


def _budget(mass: Array, num_gaussians: int) -> Indices:
    """Share Gaussians out in proportion to mass, at least one each; one each to the largest where they do not last."""
    budget = np.zeros(len(mass), dtype=np.int64)
    if num_gaussians <= len(mass):
        budget[np.argsort(-mass, kind="stable")[:num_gaussians]] = 1
        return budget
    open_ = np.ones(len(mass), dtype=bool)
    while True:
        quota = mass * (num_gaussians - (~open_).sum()) / mass[open_].sum()
        small = open_ & (quota < 1)
        if not small.any():
            break
        open_ &= ~small
    budget[~open_] = 1
    budget[open_] = np.floor(quota[open_])
    rest = np.where(open_, quota - budget, -1.0)
    budget[np.argsort(-rest, kind="stable")[: num_gaussians - budget.sum()]] += 1
    return budget


def _draw(weights: Array, count: int, rng: np.random.Generator) -> Indices:
    """Positions drawn in proportion to weight, in order; without replacement while there are enough."""
    if count > len(weights):
        again = rng.choice(len(weights), count - len(weights), p=weights / weights.sum())
        return np.sort(np.concatenate([np.arange(len(weights)), again]))
    if count == len(weights):
        return np.arange(count)
    # the first arrivals of Poisson clocks of these rates
    arrivals = rng.standard_exponential(len(weights)) / weights
    return np.sort(np.argpartition(arrivals, count)[:count])


def _spread_repeats(centres: Array, pixels: Indices, rng: np.random.Generator) -> Array:
    """Move every centre that shares its pixel with the one before it to a random place in that pixel."""
    repeated = np.flatnonzero(np.diff(pixels, prepend=-1) == 0)
    centres[repeated] += rng.uniform(-0.45, 0.45, (len(repeated), 2))
    return centres


def _cells(
    pixels: Indices, density: Array, values: Array, width: int, count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Centres (K, 2), factors (K, 3) and mean colours (K, C) of `count` cells of one region.

    Args:
        pixels: of the region, flat positions in the image, (P,).
        density: of each, (P,).
        values: of all pixels of the image, (H * W, C).
        width: of the image.
        count: K.
        rng: of the draws.
    """
    from scipy.spatial import cKDTree

    places = np.stack([pixels % width, pixels // width], -1) + 0.5
    first = _draw(density, count, rng)
    centres = _spread_repeats(places[first], first, rng)
    if count < len(pixels):
        drawn = places[_draw(density, min(len(pixels), max(_PIXELS_A_CELL[0] * count, _PIXELS_A_REGION)), rng)]
        for _ in range(_ROUNDS):
            cell = cKDTree(centres).query(drawn)[1]
            size = np.bincount(cell, minlength=count)[:, None]
            centres = np.where(size > 0, _sums(drawn, cell, count) / np.maximum(size, 1), centres)
    even = min(len(pixels), max(_PIXELS_A_CELL[1] * count, _PIXELS_A_REGION))
    at = np.arange(even) * len(pixels) // even
    tree = cKDTree(centres)
    cell = tree.query(places[at])[1]
    # a cell without a pixel takes the pixel nearest to it
    size = np.bincount(cell, minlength=count)
    lost = np.flatnonzero(size == 0)
    if len(lost):
        at = np.concatenate([at, cKDTree(places).query(centres[lost])[1]])
        cell = np.concatenate([cell, lost])
        size = np.bincount(cell, minlength=count)
    away = places[at] - centres[cell]
    products = np.stack([away[:, 0] ** 2, away[:, 0] * away[:, 1], away[:, 1] ** 2], -1)
    covariance = _sums(products, cell, count) / size[:, None] * _SPREAD**2
    return centres, _factor(covariance), _sums(values[pixels[at]], cell, count) / size[:, None]


def _sums(values: Array, cell: Indices, count: int) -> Array:
    """Sum rows of (P, D) by cell, (K, D)."""
    return np.stack([np.bincount(cell, column, minlength=count) for column in values.T], -1)


def _factor(covariance: Array) -> Array:
    """Cholesky factors of (xx, xy, yy), no axis thinner than `_LEAST_SIGMA` in pixels."""
    # a pixel is a square, not a point: its own variance comes on top
    xx, xy, yy = covariance[:, 0] + _LEAST_SIGMA**2, covariance[:, 1], covariance[:, 2] + _LEAST_SIGMA**2
    l11 = np.sqrt(xx)
    return np.stack([l11, xy / l11, np.sqrt(yy - xy**2 / xx)], -1)


def _field(image: Tensor, centres: Array, cholesky: Array, colors: Array) -> GaussianField:
    means, factors, shades = (torch.from_numpy(values).to(image) for values in (centres, cholesky, colors))
    return GaussianField(means, factors, shades, size=(image.shape[1], image.shape[2]))


def _solve_colors(field: GaussianField, image: Tensor, regions: RegionMap | None, backend: str) -> GaussianField:
    """Take a few steps of conjugate gradients from the scaled mean colours towards the least squared error, in place.

    They are worth 6 to 8 dB at the start of a fit and still 0.3 to 0.7 after 100 iterations; twice as many add little.
    """
    means, cholesky = field.means.detach(), field.cholesky.detach()
    with torch.enable_grad():
        colors = (0.4 * field.colors.detach()).requires_grad_()
        picture = region_splat(means, cholesky, colors, field.region_ids, regions, size=field.size, backend=backend)

    def project(error: Tensor) -> Tensor:
        return torch.autograd.grad(picture, colors, error, retain_graph=True)[0]

    with torch.no_grad():
        solved, error = colors.detach().clone(), image - picture.detach()
        slope = project(error)
        way, size = slope, slope.square().sum()
        for _ in range(_COLOR_STEPS):
            ahead = region_splat(means, cholesky, way, field.region_ids, regions, size=field.size, backend=backend)
            step = size / ahead.square().sum().clamp_min(torch.finfo(ahead.dtype).tiny)
            solved += step * way
            error = error - step * ahead
            slope = project(error)
            fresh = slope.square().sum()
            way = slope + fresh / size.clamp_min(torch.finfo(ahead.dtype).tiny) * way
            size = fresh
        field.colors.copy_(solved)
    return field


def _random(
    image: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int, backend: str = "auto"
) -> GaussianField:
    sigma = max(1.0, 0.5 * math.sqrt(image.shape[1] * image.shape[2] / num_gaussians))
    return random_field(image, num_gaussians, sigma, regions, seed)


# image, number of Gaussians, map, seed
INITIALIZERS: dict[str, Callable[..., GaussianField]] = {
    "random": _random,
    "gradient": sampled_field,
    "kmeans": kmeans_field,
}
