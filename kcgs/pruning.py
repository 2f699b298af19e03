"""Remove the Gaussians that an image does not need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs._repr import brief
from kcgs.nn import GaussianField, RegionSplatRenderer, used_rows
from kcgs.scene import Scene, check_scene


@brief
class PruneResult(NamedTuple):
    """A pruned scene, with numbers for one image, or (B,) tensors for a batch."""

    scene: Scene
    num_pruned: int | Tensor
    """Number of removed Gaussians; (B,) for a batch: rows that became unused."""
    prune_error: float | Tensor
    """Largest change of a value of the image; (B,) for a batch."""


def prune(scene: Scene, tolerance: float = 1e-3, *, cutoff: float = 1e-4, backend: str = "auto") -> PruneResult:
    """Remove as many Gaussians as possible while no value of the image changes by more than `tolerance`.

    Gaussians with the smallest effect on the image are removed first. The tolerance bounds the sum of their effects:
    a render of all removed Gaussians with the absolute values of their colours nowhere exceeds it. In a batch all
    images have the same number of rows, so the rows of removed Gaussians stay, unused (colour 0).

    Args:
        scene: of one image, or a batch.
        tolerance: largest change of a value of the image, at least 0; 0 removes Gaussians without any effect.
        cutoff: of the renderer.
        backend: of the renderer.

    Returns:
        The pruned scene (no graph), the number of removed Gaussians, and the measured largest change.

    Raises:
        TypeError, ValueError: as the renderer; tolerance negative or not finite.

    Example:
        >>> from kcgs import GaussianField
        >>> scene = Scene(GaussianField.random(50, (32, 48), seed=0))
        >>> with torch.no_grad():
        ...     scene.field.means[:20] += 1000.0
        >>> result = prune(scene)
        >>> result.num_pruned, result.prune_error
        (20, 0.0)
    """
    tolerance = check_number("tolerance", tolerance, 0.0)
    render = RegionSplatRenderer(cutoff=cutoff, backend=backend)
    if isinstance(scene, Scene) and scene.num_images is not None:
        return _prune_batch(scene, tolerance, render)
    check_scene(scene)
    total = scene.num_gaussians
    if scene.regions is not None and scene.field.region_ids is not None:
        scene = _subset(scene, scene.regions.index_of(scene.field.region_ids) >= 0)
    if scene.num_gaussians == 0:
        return PruneResult(_subset(scene, torch.zeros(0, dtype=torch.bool)), total, 0.0)

    order = _effects(scene, render).argsort(stable=True)
    magnitudes = _recolor(scene, scene.field.merged_colors().detach().abs())
    with torch.no_grad():
        low, high = 0, scene.num_gaussians  # removing the first `low` is allowed, the first `high + 1` is not
        while low < high:
            middle = (low + high + 1) // 2
            within = float(render(_subset(magnitudes, order[:middle])).max()) <= tolerance
            low, high = (middle, high) if within else (low, middle - 1)
        pruned = _subset(scene, order[low:].sort().values)
        change = float((render(scene) - render(pruned)).abs().max())
    return PruneResult(pruned, total - pruned.num_gaussians, change)


def _prune_batch(scene: Scene, tolerance: float, render: RegionSplatRenderer) -> PruneResult:
    """Prune all images of a batch at once: see `prune`."""
    colors, regions, ids = scene.field.merged_colors().detach(), scene.regions, scene.field.region_ids
    was_used = used_rows(colors)
    if regions is not None and ids is not None:
        colors = torch.where((regions.index_of(ids) >= 0)[..., None], colors, 0.0)
    if colors.numel() == 0:
        zeros = colors.new_zeros(len(colors))
        return PruneResult(_recolor(scene, colors), zeros.long(), zeros)
    rank = _effects(_recolor(scene, colors), render).argsort(stable=True).argsort()
    with torch.no_grad():
        low = torch.zeros_like(rank[:, 0])
        high = torch.full_like(low, rank.shape[1])
        while bool((low < high).any()):
            middle = (low + high + 1) // 2
            removed = torch.where((rank < middle[:, None])[..., None], colors.abs(), 0.0)
            within = render(_recolor(scene, removed)).amax((1, 2, 3)) <= tolerance
            low, high = torch.where(within, middle, low), torch.where(within, high, middle - 1)
        pruned = _recolor(scene, torch.where((rank < low[:, None])[..., None], 0.0, colors))
        change = (render(scene) - render(pruned)).abs().amax((1, 2, 3))
    return PruneResult(pruned, (was_used & ~used_rows(pruned.field.colors)).sum(1), change)


def _subset(scene: Scene, mask: Tensor) -> Scene:
    return Scene(scene.field.subset(mask), scene.regions, scene.metadata)


def _recolor(scene: Scene, colors: Tensor) -> Scene:
    field = scene.field
    means, cholesky = field.means.detach(), field.cholesky.detach()
    colored = GaussianField(means, cholesky, colors, field.region_ids, size=field.size)
    return Scene(colored, scene.regions, scene.metadata)


@torch.inference_mode(False)
@torch.enable_grad()
def _effects(scene: Scene, render: RegionSplatRenderer) -> Tensor:
    """Return a bound of each Gaussian's effect: its largest colour value times its summed weights, at most 1."""
    colors = scene.field.merged_colors().detach().clone()
    probe = _recolor(scene, torch.ones_like(colors))
    probe.field.means.requires_grad_(False)
    probe.field.cholesky.requires_grad_(False)
    render(probe).sum().backward()
    assert probe.field.colors.grad is not None
    return colors.abs().amax(-1) * probe.field.colors.grad[..., 0].clamp_max(1.0)
