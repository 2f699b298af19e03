"""Gaussians for the hole that an edit leaves, fitted to a smooth continuation of the image."""

from __future__ import annotations

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
from .masks import dilate

# Tuned on the photos of `python -m benchmarks fill`.
# pixels around the hole that still have colours of the object: they are filled too
_FRINGE = 3
# a Gaussian with more than this share of its weight in the hole is fitted
_FREE_SHARE = 0.01
# a Gaussian with more than this share of its weight in the hole is removed
_REMOVED_SHARE = 0.5
# most Gaussians that are added: a large hole gets larger ones
_MAX_ADDED = 250
# least distance of Gaussians that are added, in pixels
_MIN_SPACING = 3.0
# their standard deviation, in that distance
_SIGMA = 0.7
# weight of a known pixel in the fit, where that of a filled one is 1: what is visible already must not change
_KNOWN_WEIGHT = 4.0
_STEPS = 150
# learning rates of geometry and colours: at higher ones Gaussians that are alike swing, and the hole shows ripples
_RATE = 0.07
_COLOR_RATE = 0.015


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
    filled = visible | _fringe(visible, regions.labels)
    unknown = hole | filled
    if not filled.any():
        return scene
    with threads_for_kernels(unknown.numel()), torch.no_grad():
        target = inpaint(scene(), unknown)
        share = _share_in(scene.field, ids, regions, unknown)
        fixed = scene.field.subset(share <= _FREE_SHARE)
        free = scene.field.subset((share > _FREE_SHARE) & (share <= _REMOVED_SHARE))
        target = target - Scene(fixed, regions)()
        free = join(free, _spread(target - Scene(free, regions)(), filled, regions))
        weight = torch.where(unknown, filled.to(target), _KNOWN_WEIGHT)
        return Scene(join(fixed, _fit(free, regions, target, weight)), regions, scene.metadata)


def _fringe(mask: Tensor, labels: Tensor) -> Tensor:
    """Return the pixels near a mask, (H, W) bool, of the regions that are in it and go on farther away."""
    near = dilate(mask, _FRINGE)
    return near & torch.isin(labels, labels[mask].unique()) & torch.isin(labels, labels[~near].unique())


@torch.enable_grad()
def _share_in(field: GaussianField, ids: Tensor, regions: RegionMap, hole: Tensor) -> Tensor:
    """Return the share of the weight of each Gaussian that is in the hole, (N,)."""
    ones = torch.ones_like(field.colors[:, :1]).requires_grad_()
    total = region_splat(field.means.detach(), field.cholesky.detach(), ones, ids, regions)
    # the render is linear in the colours: the gradient of its sum over a mask is each Gaussian's weight there
    inside, everywhere = (
        torch.autograd.grad(total, ones, mask.to(total)[None], retain_graph=True)[0][:, 0]
        for mask in (hole, torch.ones_like(hole))
    )
    return inside / everywhere.clamp_min(1e-9)


def _spread(residual: Tensor, mask: Tensor, regions: RegionMap) -> GaussianField:
    """Spread round Gaussians over a mask that together about make the residual there."""
    spacing = max(_MIN_SPACING, float(mask.sum() / _MAX_ADDED) ** 0.5)
    rows, cols = (torch.arange(min(spacing, n) / 2, n, spacing, device=mask.device).long() for n in mask.shape)
    grid = torch.zeros_like(mask)
    grid[rows[:, None], cols] = True
    y, x = (grid & mask).nonzero().T
    means, ids = torch.stack([x, y], -1).to(residual) + 0.5, regions.labels[y, x]
    cholesky = residual.new_tensor([_SIGMA * spacing, 0.0, _SIGMA * spacing]).expand(len(x), 3)
    total = region_splat(means, cholesky, torch.ones_like(means[:, :1]), ids, regions)[:, y, x]
    return GaussianField(means, cholesky, (residual[:, y, x] / total).T, ids, size=regions.size)


@torch.enable_grad()
def _fit(field: GaussianField, regions: RegionMap, target: Tensor, weight: Tensor) -> GaussianField:
    """Fit Gaussians to a target, with a weight per pixel; opacities are merged into the colours."""
    geometry = field.means.detach(), field.cholesky.detach()
    field = GaussianField(*geometry, field.merged_colors().detach(), field.region_ids, size=field.size)
    rate, color_rate = field.means.detach().new_tensor([_RATE, _COLOR_RATE])
    optimizer = GaussianAdam(field, rate, color_lr=color_rate)
    schedule = LambdaLR(optimizer, lambda step: cosine_decay(step / _STEPS))
    for _ in range(_STEPS):
        rendered = region_splat(field.means, field.cholesky, field.colors, field.region_ids, regions)
        rendered.backward((rendered.detach() - target) * weight)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
    return field
