"""Fill the hole that an edit leaves: fit Gaussians to copies of other parts of the image."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import pad

from kcgs.compiled import threads_for_kernels
from kcgs.functional import region_splat
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField, join
from kcgs.optim import (
    End,
    FieldState,
    GaussianAdam,
    Gaussians,
    Renderer,
    SquaredError,
    cosine_decay,
    count_iterations,
    run,
    step_field,
)
from kcgs.scene import Scene

from .inpainting import inpaint_from_matches
from .masks import dilate

# pixels around a region that may have its colours, since edges in photos are blurred and masks are not exact
MARGIN = 6
# half the width, in pixels, of gaps that are filled too
_CLOSING = 8
# Gaussians with a larger share of their weight in the hole are fitted; a higher threshold leaves traces of the object
_FITTED_SHARE = 0.05
# Gaussians with a larger share of their weight in the hole are removed: if they were fitted, they would become dots
_REMOVED_SHARE = 0.8
# Gaussians per pixel that are added in a hole, as a multiple of the density around it
_DENSITY = 2.0
# least number of added Gaussians
_LEAST_ADDED = 16
# standard deviation of added Gaussians, in their spacing
_SIGMA = 0.6
# iterations of the fit
_ITERATIONS = 120
# weights below it are skipped in renders
_CUTOFF = 1e-4
# learning rate of positions and shapes; with a larger rate similar Gaussians oscillate, and the hole shows ripples
_RATE = 0.07
# learning rate of colours; a larger rate has the same effect
_COLOR_RATE = 0.015


def fill_hole(scene: Scene, hole: Tensor, visible: Tensor, margin: int) -> Scene:
    """Fill a hole from its surroundings.

    Args:
        scene: with a map that covers the hole.
        hole: pixels of the removed regions, :math:`(H, W)` bool.
        visible: the part of the hole to fill, of the same shape.
        margin: width of the rim around it that is filled too, in pixels.

    Returns:
        The scene without the Gaussians inside the hole. Gaussians that reach into the hole are fitted to its
        surroundings, together with new Gaussians.
    """
    regions = scene.regions
    assert regions is not None
    fill_mask = visible | _fringe(visible, regions.labels, margin)
    unknown = hole | fill_mask
    if not fill_mask.any():
        return scene
    with threads_for_kernels(unknown.numel()), torch.no_grad():
        target = inpaint_from_matches(scene(), unknown)
        share = _share_in(scene.field, regions, unknown)
        fixed = scene.field.subset(share <= _FITTED_SHARE)
        fitted = scene.field.subset((share > _FITTED_SHARE) & (share <= _REMOVED_SHARE))
        target = target - Scene(fixed, regions)()
        density = _DENSITY * scene.num_gaussians / float((~hole).sum())
        fitted = join(fitted, _spread(target - Scene(fitted, regions)(), fill_mask, regions, density))
        weight = (fill_mask | ~unknown).to(target)
        return Scene(join(fixed, _fit(fitted, regions, target, weight)), regions, scene.metadata)


def _fringe(mask: Tensor, labels: Tensor, width: int) -> Tensor:
    """Return the pixels near a mask and in its gaps, (H, W) bool, of regions that extend from the mask farther out."""
    # padding: gaps between the mask and the border of the image are not filled
    margin = width + _CLOSING
    wide = dilate(pad(mask, (margin,) * 4), margin)
    near = ~dilate(~wide, _CLOSING)[margin:-margin, margin:-margin]
    return near & torch.isin(labels, labels[mask].unique()) & torch.isin(labels, labels[~near].unique())


def _share_in(field: GaussianField, regions: RegionMap, hole: Tensor) -> Tensor:
    """Return the share of the weight of each Gaussian that is in the hole, (N,)."""
    total, sums = Renderer(field.size, regions, _CUTOFF).weight_sums(Gaussians.of(field))
    return sums(hole.to(total)[None]) / sums(torch.ones_like(total)).clamp_min(1e-9)


def _spread(residual: Tensor, mask: Tensor, regions: RegionMap, density: float) -> GaussianField:
    """Spread round Gaussians over a mask so that their render is about the residual."""
    spacing = max(1.0, max(density, _LEAST_ADDED / float(mask.sum())) ** -0.5)
    rows, cols = (torch.arange(min(spacing, n) / 2, n, spacing, device=mask.device).long() for n in mask.shape)
    grid = torch.zeros_like(mask)
    grid[rows[:, None], cols] = True
    y, x = (grid & mask).nonzero().T
    means, ids = torch.stack([x, y], -1).to(residual) + 0.5, regions.labels[y, x]
    sigma = _SIGMA * spacing
    cholesky = residual.new_tensor([sigma, 0.0, sigma]).expand(len(x), 3)
    total = region_splat(means, cholesky, torch.ones_like(means[:, :1]), ids, regions)[:, y, x]
    return GaussianField(means, cholesky, (residual[:, y, x] / total).T, ids, size=regions.size)


def _fit(field: GaussianField, regions: RegionMap, target: Tensor, weight: Tensor) -> GaussianField:
    """Fit Gaussians to a target, with a weight per pixel; opacities are merged into the colours."""
    field = Gaussians.of(field).field(field.size)
    # tensors, so that the schedule also has the precision of the field
    rate, color_rate = field.means.detach().new_tensor([_RATE, _COLOR_RATE])
    optimizer = GaussianAdam(field, rate, color_lr=color_rate)
    renderer = Renderer(field.size, regions, _CUTOFF)
    state = FieldState(field, optimizer, SquaredError(target, weight=weight), renderer)
    run(state, partial(step_field, state), count_iterations(state, _ITERATIONS), [End()], cosine_decay)
    return field
