"""Gaussians for the hole that an edit leaves, fitted to a smooth continuation of the image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from kcgs.fitting.optimizers import cosine_decay
from kcgs.functional import RegionMap, region_splat
from kcgs.kernels import threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.nn.field import join
from kcgs.optim import GaussianAdam
from kcgs.scene import Scene

from .inpainting import inpaint
from .masks import FRINGE, dilate
from .weights import weight_sums


@dataclass(frozen=True)
class FillSettings:
    """Which Gaussians of a hole are fitted, and how.

    All fields are tuned on the photos of ``python -m benchmarks fill``, for values in [0, 1]: to tune one again, change
    it and compare the steepest gradients and the values beyond [0, 1] in the holes.
    """

    free_share: float = 0.01
    """A Gaussian with more than this share of its weight in the hole is fitted. More: fewer Gaussians change,
    and more of those that stay show the object in the hole."""
    removed_share: float = 0.5
    """A Gaussian with more than this share of its weight in the hole is removed instead, and new ones replace it."""
    max_added: int = 250
    """Most Gaussians that are added: a large hole gets larger ones. More: larger files, and a finer fill."""
    min_spacing: float = 3.0
    """Least distance of Gaussians that are added, in pixels: a small hole gets fewer than `max_added`."""
    sigma: float = 0.7
    """Their standard deviation, in that distance. Less: gaps between them show. More: they are alike, and swing."""
    known_weight: float = 4.0
    """Weight of a known pixel in the fit, where that of a filled one is 1. More: what is visible already changes less,
    and the hole follows it less smoothly."""
    steps: int = 150
    """Iterations of the fit. More: slower, and less error."""
    rate: float = 0.07
    """Learning rate of means and factors. More: Gaussians that are alike swing, and the hole shows ripples."""
    color_rate: float = 0.015
    """Learning rate of colours, likewise."""


_SETTINGS = FillSettings()


def fill_hole(scene: Scene, hole: Tensor, visible: Tensor) -> Scene:
    """Fill a hole from its surroundings.

    Args:
        scene: with a map that covers the hole.
        hole: where regions were, :math:`(H, W)` bool.
        visible: the part of the hole to fill, of the same shape.

    Returns:
        The scene without the Gaussians of the hole. Gaussians that reach into the hole are fitted to what is around
        it, together with new ones.
    """
    regions, ids = scene.regions, scene.field.region_ids
    assert regions is not None and ids is not None
    fill_mask = visible | _fringe(visible, regions.labels)
    unknown = hole | fill_mask
    if not fill_mask.any():
        return scene
    with threads_for_kernels(unknown.numel()), torch.no_grad():
        target = inpaint(scene(), unknown)
        share = _share_in(scene.field, ids, regions, unknown)
        fixed = scene.field.subset(share <= _SETTINGS.free_share)
        free = scene.field.subset((share > _SETTINGS.free_share) & (share <= _SETTINGS.removed_share))
        target = target - Scene(fixed, regions)()
        free = join(free, _spread(target - Scene(free, regions)(), fill_mask, regions))
        weight = torch.where(unknown, fill_mask.to(target), _SETTINGS.known_weight)
        return Scene(join(fixed, _fit(free, regions, target, weight)), regions, scene.metadata)


def _fringe(mask: Tensor, labels: Tensor) -> Tensor:
    """Return the pixels near a mask, (H, W) bool, of the regions that are in it and go on farther away."""
    near = dilate(mask, FRINGE)
    return near & torch.isin(labels, labels[mask].unique()) & torch.isin(labels, labels[~near].unique())


def _share_in(field: GaussianField, ids: Tensor, regions: RegionMap, hole: Tensor) -> Tensor:
    """Return the share of the weight of each Gaussian that is in the hole, (N,)."""
    means, cholesky = field.means.detach(), field.cholesky.detach()
    total, sums = weight_sums(lambda ones: region_splat(means, cholesky, ones, ids, regions), field.colors)
    return sums(hole.to(total)[None]) / sums(torch.ones_like(total)).clamp_min(1e-9)


def _spread(residual: Tensor, mask: Tensor, regions: RegionMap) -> GaussianField:
    """Spread round Gaussians over a mask, whose sum is about the residual there."""
    spacing = max(_SETTINGS.min_spacing, float(mask.sum() / _SETTINGS.max_added) ** 0.5)
    rows, cols = (torch.arange(min(spacing, n) / 2, n, spacing, device=mask.device).long() for n in mask.shape)
    grid = torch.zeros_like(mask)
    grid[rows[:, None], cols] = True
    y, x = (grid & mask).nonzero().T
    means, ids = torch.stack([x, y], -1).to(residual) + 0.5, regions.labels[y, x]
    sigma = _SETTINGS.sigma * spacing
    cholesky = residual.new_tensor([sigma, 0.0, sigma]).expand(len(x), 3)
    total = region_splat(means, cholesky, torch.ones_like(means[:, :1]), ids, regions)[:, y, x]
    return GaussianField(means, cholesky, (residual[:, y, x] / total).T, ids, size=regions.size)


@torch.enable_grad()
def _fit(field: GaussianField, regions: RegionMap, target: Tensor, weight: Tensor) -> GaussianField:
    """Fit Gaussians to a target, with a weight per pixel; opacities are merged into the colours."""
    geometry = field.means.detach(), field.cholesky.detach()
    field = GaussianField(*geometry, field.merged_colors().detach(), field.region_ids, size=field.size)
    # tensors, so that the schedule, too, is in the precision of the field
    rate, color_rate = field.means.detach().new_tensor([_SETTINGS.rate, _SETTINGS.color_rate])
    optimizer = GaussianAdam(field, rate, color_lr=color_rate)
    schedule = LambdaLR(optimizer, lambda step: cosine_decay(step / _SETTINGS.steps))
    for _ in range(_SETTINGS.steps):
        rendered = region_splat(field.means, field.cholesky, field.colors, field.region_ids, regions)
        rendered.backward((rendered.detach() - target) * weight)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
    return field
