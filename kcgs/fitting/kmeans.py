"""The start by k-means: every region cut into cells of equal detail."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.functional import RegionMap
from kcgs.nn import GaussianField

from .colors import ColorOperator
from .conjugate_gradients import conjugate_gradients
from .sampling import sample_pixels, spread_repeats

Array = NDArray[np.floating]
Indices = NDArray[np.int64]

# the share of the gradient in the density of centres; the rest is uniform
_GRADIENT_SHARE = 0.7
_GRADIENT_POWER = 1.3
_ROUNDS = 4
# pixels per cell that the rounds and the cells' moments are computed from, and at least per region
_PIXELS_PER_CELL = (16, 48)
_PIXELS_PER_REGION = 2000
# standard deviation of a Gaussian over that of its cell: 0.5 sqrt(area) for a square
_SPREAD = math.sqrt(3.0)
_LEAST_SIGMA = 0.5
_COLOR_STEPS, _CUTOFF = 8, 1e-4


def kmeans_field(
    image: Tensor, num_gaussians: int, regions: RegionMap | None, seed: int, backend: str = "auto"
) -> GaussianField:
    """Cut every region into cells of equal density mass by k-means; one Gaussian per cell, of its shape and colour.

    A region gets Gaussians in proportion to its mass and at least one; with fewer Gaussians than regions the regions of
    largest mass get one each, and the others stay black.
    """
    rng = np.random.default_rng(seed)
    planes = image.detach().cpu().double().numpy()
    index, density, mass = _density(planes, regions)
    budget = np.zeros(len(mass), np.int64)
    # a region may have no pixel of its own, with a map finer than the image
    budget[mass > 0] = _budget(mass[mass > 0], num_gaussians)
    # pixels sorted by region, raster order within
    order = np.argsort(index, axis=None, kind="stable")
    members = np.split(order, np.bincount(index.ravel(), minlength=len(mass)).cumsum()[:-1])
    values = planes.reshape(len(planes), -1).T
    parts = []
    for region in np.flatnonzero(budget):
        pixels = members[region]
        parts.append(_cells(pixels, density.ravel()[pixels], values, index.shape[1], int(budget[region]), rng))
    tensors = (torch.from_numpy(np.concatenate(columns)).to(image) for columns in zip(*parts, strict=True))
    field = GaussianField(*tensors, size=(image.shape[1], image.shape[2]))
    if regions is not None:
        field.region_ids = regions.ids[torch.from_numpy(np.repeat(np.arange(len(budget)), budget)).to(image.device)]
    # a few steps from the scaled mean colours gain 6 to 8 dB at the start of a fit and still 0.3 to 0.7 after 100
    # iterations; twice as many add little
    colors = 0.4 * field.colors.detach()
    operator = ColorOperator(field, regions, colors, _CUTOFF, backend)
    colors = conjugate_gradients(
        colors, image - operator.rendered.detach(), operator.render, _COLOR_STEPS, gradient=operator.adjoint,
        dot=lambda a, b: (a * b).sum(), least_squares=True,
    )  # fmt: skip
    with torch.no_grad():
        field.colors.copy_(colors)
    return field


def gaussian_shares(image: Tensor, regions: RegionMap) -> Tensor:
    """Share of the Gaussians that `kmeans_field` gives every region of the map, (R,), the rounding left aside."""
    mass = _density(image.detach().cpu().double().numpy(), regions)[2]
    return torch.from_numpy(mass / mass.sum())


def _density(planes: Array, regions: RegionMap | None) -> tuple[Indices, Array, Array]:
    """Place of every pixel's region in the map's ids, density of the cells' centres, and its sum over each region."""
    index: Indices = np.zeros(planes.shape[1:], np.int64)
    if regions is not None:
        index = regions.index[0].cpu().numpy().astype(np.int64)
    slope = _slope(planes, index)
    density: Array = np.full(index.shape, 1.0 - _GRADIENT_SHARE)
    if slope.any():
        density += _GRADIENT_SHARE * (slope / slope.mean()) ** _GRADIENT_POWER
    mass = np.bincount(index.ravel(), density.ravel(), minlength=1 if regions is None else regions.num_regions)
    return index, density, mass.astype(np.float64)


def _slope(planes: Array, index: Indices) -> Array:
    """Root mean square difference to the neighbours of the same region, over channels, (H, W)."""
    total, count = np.zeros(index.shape), np.zeros(index.shape)
    for axis in (0, 1):
        same = np.diff(index, axis=axis) == 0
        difference = np.square(np.diff(planes, axis=axis + 1)).sum(0) * same
        for sums, values in ((total, difference), (count, same)):
            sums.swapaxes(0, axis)[:-1] += values.swapaxes(0, axis)
            sums.swapaxes(0, axis)[1:] += values.swapaxes(0, axis)
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


def _cells(
    pixels: Indices, density: Array, values: Array, width: int, count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Centres (K, 2), factors (K, 3) and mean colours (K, C) of `count` cells of one region.

    `pixels` are the region's, flat; `density` is theirs; `values`, (H * W, C), are those of all pixels of the image.
    """
    from scipy.spatial import cKDTree

    places = np.stack([pixels % width, pixels // width], -1) + 0.5
    first = sample_pixels(density, count, rng)
    centres = spread_repeats(places[first], first, rng)
    if count < len(pixels):
        enough = min(len(pixels), max(_PIXELS_PER_CELL[0] * count, _PIXELS_PER_REGION))
        sampled = places[sample_pixels(density, enough, rng)]
        for _ in range(_ROUNDS):
            cell = cKDTree(centres).query(sampled)[1]
            size = np.bincount(cell, minlength=count)[:, None]
            centres = np.where(size > 0, _sums(sampled, cell, count) / np.maximum(size, 1), centres)
    even = min(len(pixels), max(_PIXELS_PER_CELL[1] * count, _PIXELS_PER_REGION))
    seen = np.arange(even) * len(pixels) // even
    tree = cKDTree(centres)
    cell = tree.query(places[seen])[1]
    # a cell without a pixel takes the pixel nearest to it
    size = np.bincount(cell, minlength=count)
    lost = np.flatnonzero(size == 0)
    if len(lost):
        seen = np.concatenate([seen, cKDTree(places).query(centres[lost])[1]])
        cell = np.concatenate([cell, lost])
        size = np.bincount(cell, minlength=count)
    x, y = (places[seen] - centres[cell]).T
    products = np.stack([x**2, x * y, y**2], -1)
    covariance = _sums(products, cell, count) / size[:, None] * _SPREAD**2
    return centres, _factor(covariance), _sums(values[pixels[seen]], cell, count) / size[:, None]


def _sums(values: Array, cell: Indices, count: int) -> Array:
    """Sum rows of (P, D) by cell, (K, D)."""
    return np.stack([np.bincount(cell, column, minlength=count) for column in values.T], -1)


def _factor(covariance: Array) -> Array:
    """Cholesky factors of (xx, xy, yy), no axis thinner than `_LEAST_SIGMA` in pixels."""
    # a pixel is a square, not a point: its own variance comes on top
    xx, xy, yy = covariance[:, 0] + _LEAST_SIGMA**2, covariance[:, 1], covariance[:, 2] + _LEAST_SIGMA**2
    l11 = np.sqrt(xx)
    return np.stack([l11, xy / l11, np.sqrt(yy - xy**2 / xx)], -1)
