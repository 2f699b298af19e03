"""Fill what an edit uncovers: Gaussians fitted to an image that goes on smoothly into the hole."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

from kcgs.fitting.optimizers import FrameAdam
from kcgs.functional import RegionMap, region_splat
from kcgs.kernels import threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.nn.field import join
from kcgs.scene import Scene

# pixels around the hole that still have colours of what was there: they are filled too
_FRINGE = 3
# the fit moves a Gaussian with more than this share of its weight in the hole; one with more than that share goes
_IN_HOLE = 0.01
_LOST = 0.5
# Gaussians that are spread over a hole at most, their least distance in pixels, and their deviation in distances
_MOST_SPREAD = 250
_LEAST_DISTANCE = 3.0
_SIGMA = 0.7
# what a known pixel counts in the fit: what is seen already must not change
_KNOWN_WEIGHT = 4.0
_STEPS = 150
# of the learning rates: with more, Gaussians that are alike swing, and the hole shows ripples
_RATE = 0.5


def fill_hole(scene: Scene, hole: Tensor, seen: Tensor) -> Scene:
    """Fill a hole from its surroundings.

    Args:
        scene: what is left; its map covers the hole.
        hole: where regions were, :math:`(H, W)` bool.
        seen: the part of it that is to be filled, of the same shape.

    Returns:
        The scene without the Gaussians of the hole, those that reach into it moved, and others added behind them.
    """
    regions, ids = scene.regions, scene.field.region_ids
    assert regions is not None and ids is not None
    wanted = seen | _fringe(seen, regions.labels)
    unknown = hole | wanted
    if not wanted.any():
        return scene
    with threads_for_kernels(unknown.numel()), torch.no_grad():
        rendered = scene()
        target = inpaint(rendered, unknown)
        share = _share_in(scene.field, ids, regions, unknown)
        stays = scene.field.subset(share <= _IN_HOLE)
        moves = scene.field.subset((share > _IN_HOLE) & (share <= _LOST))
        target = target - Scene(stays, regions)()
        start = join(moves, _spread(target - Scene(moves, regions)(), wanted, regions))
        weight = torch.where(unknown, wanted.to(target), _KNOWN_WEIGHT)
        return Scene(join(stays, _fit(start, regions, target, weight)), regions, scene.metadata)


def grow(mask: Tensor, reach: int) -> Tensor:
    """Add the pixels within so many of a mask (H, W)."""
    return max_pool2d(mask[None].float(), 2 * reach + 1, 1, reach)[0] > 0


def inpaint(image: Tensor, unknown: Tensor) -> Tensor:
    """Continue an image (C, H, W) into its unknown pixels, (H, W) bool, not all: each is a mean of what is around it.

    Source: Gortler, Grzeszczuk, Szeliski and Cohen, "The Lumigraph", 1996: pull and push.
    """
    return torch.where(unknown, _pull_push(image, (~unknown).to(image)[None]), image)


def _pull_push(image: Tensor, weight: Tensor) -> Tensor:
    """Fill where the weight (1, H, W) is below 1 from the image at half the size, filled in the same way."""
    height, width = weight.shape[1:]
    if height * width == 1:
        return image
    even = 0, width % 2, 0, height % 2
    sums, shares = (avg_pool2d(pad(t, even), 2) for t in (image * weight, weight))
    coarse = _pull_push(sums / shares.clamp_min(1e-9), (4 * shares).clamp_max(1.0))
    smooth = interpolate(coarse[None], scale_factor=2, mode="bilinear")[0, :, :height, :width]
    return smooth.lerp(image, weight)


def _fringe(mask: Tensor, labels: Tensor) -> Tensor:
    """Say which pixels are near a mask, of the regions that are in it and go on farther away."""
    near = grow(mask, _FRINGE)
    return near & torch.isin(labels, labels[mask].unique()) & torch.isin(labels, labels[~near].unique())


@torch.enable_grad()
def _share_in(field: GaussianField, ids: Tensor, regions: RegionMap, hole: Tensor) -> Tensor:
    """Return the share of the weight of each Gaussian that is in the hole, (N,)."""
    ones = torch.ones_like(field.colors[:, :1]).requires_grad_()
    total = region_splat(field.means.detach(), field.cholesky.detach(), ones, ids, regions)
    # the render is linear in the colours: the gradient of a sum is the weight that each Gaussian has there
    inside, everywhere = (
        torch.autograd.grad(total, ones, mask.to(total)[None], retain_graph=True)[0][:, 0]
        for mask in (hole, torch.ones_like(hole))
    )
    return inside / everywhere.clamp_min(1e-9)


def _spread(missing: Tensor, wanted: Tensor, regions: RegionMap) -> GaussianField:
    """Spread round Gaussians over the hole that together make about what is missing there."""
    distance = max(_LEAST_DISTANCE, float(wanted.sum() / _MOST_SPREAD) ** 0.5)
    rows, cols = (torch.arange(min(distance, n) / 2, n, distance, device=wanted.device).long() for n in wanted.shape)
    places = torch.zeros_like(wanted)
    places[rows[:, None], cols] = True
    y, x = (places & wanted).nonzero().T
    means, ids = torch.stack([x, y], -1).to(missing) + 0.5, regions.labels[y, x]
    cholesky = missing.new_tensor([_SIGMA * distance, 0.0, _SIGMA * distance]).expand(len(x), 3)
    total = region_splat(means, cholesky, torch.ones_like(means[:, :1]), ids, regions)[:, y, x]
    return GaussianField(means, cholesky, (missing[:, y, x] / total).T, ids, size=regions.size)


@torch.enable_grad()
def _fit(start: GaussianField, regions: RegionMap, target: Tensor, weight: Tensor) -> GaussianField:
    """Descend to a target from Gaussians."""
    optimizer = FrameAdam(start, _RATE)
    for step in range(_STEPS):
        rendered = region_splat(*optimizer.gaussians(), start.region_ids, regions)
        rendered.backward((rendered.detach() - target) * weight)
        optimizer.step(optimizer.decay(step / _STEPS))
    return GaussianField(*optimizer.gaussians(), start.region_ids, size=start.size)
