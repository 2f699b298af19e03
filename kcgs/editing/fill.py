"""Fill what an edit uncovers: Gaussians fitted to an image that is continued into the hole."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.fitting.optimizers import FrameAdam
from kcgs.functional import RegionMap, region_splat
from kcgs.kernels import threads_for_kernels
from kcgs.nn import GaussianField
from kcgs.nn.field import join
from kcgs.scene import Scene

from .inpaint import grow, inpaint

# so many pixels around the hole still have colours of what was there: they are filled too
_FRINGE = 3
# pixels around the hole that the fit sees, and that the target is made from
_MARGIN = 40
# the fit moves a Gaussian with more than this share of its weight in the hole, and less than this where it cannot see
_IN_HOLE, _OUT_OF_SIGHT = 0.01, 0.01
# Gaussians that are spread over a hole at most, their least distance in pixels, and their deviation in distances:
# at 0.7 they add up to a constant within 1 in 1000
_MOST_SPREAD, _LEAST_DISTANCE, _SIGMA = 250, 3.0, 0.7
# a known pixel counts this many times in the fit: what is seen already must not change
_KNOWN_WEIGHT = 4.0
_STEPS = 300
# at these steps, Gaussians of this deviation in pixels are added at this many of the largest errors above the least
_ADD_STEPS, _MOST_ADDED, _LEAST_ERROR, _ADDED_SIGMA = (30, 90, 150, 210), 60, 0.03, 0.8
# of an error, which its neighbours have a share in
_ADDED_GAIN = 0.6


class _Gaussians(NamedTuple):
    means: Tensor
    cholesky: Tensor
    colors: Tensor
    region_ids: Tensor

    def render(self, regions: RegionMap) -> Tensor:
        return region_splat(*self, regions)

    def with_more(self, others: _Gaussians) -> _Gaussians:
        return _Gaussians(*(torch.cat([a, b]) for a, b in zip(self, others, strict=True)))


class _Window(NamedTuple):
    """The part of the image that the fit sees."""

    rows: slice
    cols: slice

    @classmethod
    def around(cls, mask: Tensor) -> _Window:
        spans = []
        for axis, length in ((1, mask.shape[0]), (0, mask.shape[1])):
            places = mask.any(axis).nonzero().flatten()
            spans.append(slice(max(0, int(places[0]) - _MARGIN), min(length, int(places[-1]) + 1 + _MARGIN)))
        return cls(*spans)

    def part(self, image: Tensor) -> Tensor:
        return image[..., self.rows, self.cols]

    def origin(self, like: Tensor) -> Tensor:
        return like.new_tensor([self.cols.start, self.rows.start])


def fill_hole(scene: Scene, hole: Tensor, seen: Tensor) -> Scene:
    """Fill a hole from its surroundings.

    Args:
        scene: what is left; its map covers the hole.
        hole: where regions were, at the resolution of the map, :math:`(k H, k W)` bool.
        seen: the part of it that is to be filled, of the same shape.

    Returns:
        The scene with the Gaussians that reach into the hole moved, and others added behind them.

    Raises:
        ValueError: no pixel is free of the hole.
    """
    regions, ids = scene.regions, scene.field.region_ids
    assert regions is not None and ids is not None
    unknown, wanted = (_pixels(mask, regions.supersample) for mask in (hole, seen))
    wanted = wanted | _fringe(wanted, regions.labels)
    unknown = unknown | wanted
    if not wanted.any():
        return scene
    if unknown.all():
        raise ValueError('fill must be None where the hole reaches into every pixel; got "inpaint"')
    with threads_for_kernels(unknown.numel()):
        return _fill(scene, ids, regions, unknown, wanted)


def _fill(scene: Scene, ids: Tensor, regions: RegionMap, unknown: Tensor, wanted: Tensor) -> Scene:
    with torch.no_grad():
        rendered = scene()
    window = _Window.around(unknown)
    unknown_part, wanted_part, now = (window.part(image) for image in (unknown, wanted, rendered))
    target = inpaint(now, unknown_part)
    part = _crop(regions, window)
    free = _reaching_in(scene, ids, unknown, window) & torch.isin(ids, part.ids)
    start = _chosen(scene.field, ids, free, window)
    missing = target - now
    spread = _spread(missing, wanted_part, part)
    weight = torch.where(unknown_part, wanted_part.to(target.dtype), _KNOWN_WEIGHT)
    # what all others make, which stays
    fixed = now - start.render(part)
    fitted = _fit(start.with_more(spread), part, target - fixed, weight)
    moved = GaussianField(fitted.means + window.origin(fitted.means), *fitted[1:], size=scene.size)
    return Scene(join(scene.field.subset(~free), moved), regions, scene.metadata)


def _pixels(mask: Tensor, supersample: int) -> Tensor:
    """Say which pixels have any of these labels, (H, W) bool."""
    if supersample == 1:
        return mask
    return torch.nn.functional.max_pool2d(mask[None].float(), supersample)[0] > 0


def _fringe(mask: Tensor, labels: Tensor) -> Tensor:
    """Say which pixels are near a mask, of the regions that are in it and go on farther away."""
    near = grow(mask, _FRINGE)
    return near & torch.isin(labels, labels[mask].unique()) & torch.isin(labels, labels[~near].unique())


def _crop(regions: RegionMap, window: _Window) -> RegionMap:
    """Cut the window out of a map."""
    k = regions.supersample
    rows, cols = (slice(k * axis.start, k * axis.stop) for axis in window)
    labels = regions.fine_labels[rows, cols].contiguous()
    softness: float | Mapping[tuple[int, int], float] = regions.softness
    if isinstance(softness, Mapping):
        left = set(labels.unique().tolist())
        softness = {pair: width for pair, width in softness.items() if left.issuperset(pair)}
    return RegionMap.from_labels(labels, softness, supersample=k)


def _reaching_in(scene: Scene, ids: Tensor, unknown: Tensor, window: _Window) -> Tensor:
    """Say which Gaussians the fit may move, (N) bool: they have weight in the hole and hardly any out of sight."""
    field = scene.field
    ones = field.colors.detach().new_ones(field.num_gaussians, 1).requires_grad_()
    total = region_splat(field.means.detach(), field.cholesky.detach(), ones, ids, scene.regions)[0]
    sight = torch.zeros_like(unknown)
    sight[window.rows, window.cols] = True
    # the render is linear in the colours: the gradient of a sum is the weight that each Gaussian has there
    hole, outside, everywhere = (
        torch.autograd.grad((total * mask).sum(), ones, retain_graph=True)[0][:, 0]
        for mask in (unknown, ~sight, torch.ones_like(unknown))
    )
    return (hole > _IN_HOLE * everywhere) & (outside < _OUT_OF_SIGHT * everywhere)


def _chosen(field: GaussianField, ids: Tensor, mask: Tensor, window: _Window) -> _Gaussians:
    """Take Gaussians as they are in the window, opacities merged."""
    means, cholesky, colors = (t.detach()[mask] for t in (field.means, field.cholesky, field.merged_colors()))
    return _Gaussians(means - window.origin(means), cholesky, colors, ids[mask])


def _spread(missing: Tensor, wanted: Tensor, regions: RegionMap) -> _Gaussians:
    """Spread round Gaussians over the hole that together make about what is missing there."""
    distance = max(_LEAST_DISTANCE, float(wanted.sum() / _MOST_SPREAD) ** 0.5)
    rows, cols = (
        ((torch.arange(max(1, round(n / distance)), device=wanted.device) + 0.5) * distance).long().clamp_max(n - 1)
        for n in wanted.shape
    )
    places = torch.zeros_like(wanted)
    places[rows[:, None], cols[None, :]] = True
    y, x = (places & wanted).nonzero().T
    reach = int(distance / 2)
    means = torch.nn.functional.avg_pool2d(missing[None], 2 * reach + 1, 1, reach, count_include_pad=False)[0]
    colors = means[:, y, x].T / (2 * torch.pi * _SIGMA**2)
    return _round(x, y, _SIGMA * distance, colors, regions)


def _round(x: Tensor, y: Tensor, sigma: float, colors: Tensor, regions: RegionMap) -> _Gaussians:
    """Make round Gaussians at pixels, of the regions there."""
    cholesky = colors.new_tensor([sigma, 0.0, sigma]).repeat(len(x), 1)
    return _Gaussians(torch.stack([x, y], -1).to(colors) + 0.5, cholesky, colors, regions.labels[y, x])


def _fit(start: _Gaussians, regions: RegionMap, target: Tensor, weight: Tensor) -> _Gaussians:
    """Descend to a target from Gaussians, all of which may move, and add some where the error is largest."""
    ids = start.region_ids
    optimizer = FrameAdam(GaussianField(*start[:3], ids, size=regions.size), 1.0)
    for step in range(_STEPS):
        rendered = region_splat(*optimizer.gaussians(), ids, regions)
        error = (rendered.detach() - target) * weight
        rendered.backward(error)
        optimizer.step(optimizer.decay(step / _STEPS))
        if step in _ADD_STEPS:
            added = _at_errors(error, regions)
            optimizer.append(*added[:3])
            ids = torch.cat([ids, added.region_ids])
    means, cholesky, colors = (t.detach() for t in optimizer.gaussians())
    return _Gaussians(means, cholesky, colors, ids)


def _at_errors(error: Tensor, regions: RegionMap) -> _Gaussians:
    """Make small Gaussians where an error (C, H, W) is largest, not next to each other."""
    size = error.abs().amax(0)
    peak = torch.nn.functional.max_pool2d(size[None], 5, 1, 2)[0]
    score = torch.where((size == peak) & (size > _LEAST_ERROR), size, 0.0).flatten()
    count = min(_MOST_ADDED, int((score > 0).sum()))
    best = score.sort(descending=True, stable=True).indices[:count]
    y, x = best // error.shape[2], best % error.shape[2]
    return _round(x, y, _ADDED_SIGMA, -_ADDED_GAIN * error[:, y, x].T, regions)
