"""Remove the Gaussians that an image does not need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs._repr import brief
from kcgs.nn import GaussianField, RegionSplatRenderer
from kcgs.scene import Scene, check_scene


@brief
class PruneResult(NamedTuple):
    """A scene with fewer Gaussians."""

    scene: Scene
    num_pruned: int
    """Number of Gaussians that were removed."""
    prune_error: float
    """Largest change of a value of the image."""


def prune(scene: Scene, tolerance: float = 1e-3, *, cutoff: float = 1e-4, backend: str = "auto") -> PruneResult:
    """Remove as many Gaussians as possible while no value of the image changes by more than `tolerance`.

    Gaussians that paint least go first. The tolerance bounds their sum: the image that all of them render, with the
    absolute values of their colours, is nowhere above it.

    Args:
        scene: unbatched.
        tolerance: largest change of a value of the image, at least 0; 0 removes Gaussians that paint nothing.
        cutoff: of the renderer.
        backend: of the renderer.

    Returns:
        The scene that remains (no graph), the number of Gaussians removed, and the largest change, measured.

    Raises:
        TypeError, ValueError: as the renderer; a batched scene; tolerance negative or not finite.

    Example:
        >>> from kcgs import GaussianField
        >>> scene = Scene(GaussianField.random(50, (32, 48), seed=0))
        >>> with torch.no_grad():
        ...     scene.field.means[:20] += 1000.0
        >>> result = prune(scene)
        >>> result.num_pruned, result.prune_error
        (20, 0.0)
    """
    check_scene(scene)
    tolerance = check_number("tolerance", tolerance, 0.0)
    render = RegionSplatRenderer(cutoff=cutoff, backend=backend)
    total = scene.num_gaussians
    if scene.regions is not None and scene.field.region_ids is not None:
        scene = _subset(scene, scene.regions.index_of(scene.field.region_ids) >= 0)
    if scene.num_gaussians == 0:
        return PruneResult(_subset(scene, torch.zeros(0, dtype=torch.bool)), total, 0.0)

    with torch.inference_mode(False), torch.enable_grad():
        order = _effects(scene, render).argsort(stable=True)
    magnitudes = _recolor(scene, scene.field.merged_colors().detach().abs())
    with torch.no_grad():
        low, high = 0, scene.num_gaussians  # the first `low` may go, the first `high + 1` may not
        while low < high:
            middle = (low + high + 1) // 2
            within = float(render(_subset(magnitudes, order[:middle])).max()) <= tolerance
            low, high = (middle, high) if within else (low, middle - 1)
        pruned = _subset(scene, order[low:].sort().values)
        change = float((render(scene) - render(pruned)).abs().max())
    return PruneResult(pruned, total - pruned.num_gaussians, change)


def _subset(scene: Scene, mask: Tensor) -> Scene:
    return Scene(scene.field.subset(mask), scene.regions, scene.metadata)


def _recolor(scene: Scene, colors: Tensor) -> Scene:
    field = scene.field
    means, cholesky = field.means.detach(), field.cholesky.detach()
    return Scene(GaussianField(means, cholesky, colors, field.region_ids, size=field.size), scene.regions)


def _effects(scene: Scene, render: RegionSplatRenderer) -> Tensor:
    """Bound each Gaussian's effect on a value, by its colour and by the sum of all that it paints, (N,)."""
    colors = scene.field.merged_colors().detach().clone()
    probe = _recolor(scene, torch.ones_like(colors))
    probe.field.means.requires_grad_(False)
    probe.field.cholesky.requires_grad_(False)
    render(probe).sum().backward()
    assert probe.field.colors.grad is not None
    return colors.abs().amax(-1) * probe.field.colors.grad[:, 0].clamp_max(1.0)
