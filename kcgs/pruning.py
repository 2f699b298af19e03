"""Leave out the Gaussians that an image does not need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._check import check_number
from kcgs.nn import GaussianField, RegionSplatRenderer
from kcgs.scene import Scene, check_scene


class PruneResult(NamedTuple):
    """What is left, how many went, and by how much the image changed."""

    scene: Scene
    removed: int
    change: float


def prune(scene: Scene, tolerance: float = 1e-3, *, cutoff: float = 1e-4, backend: str = "auto") -> PruneResult:
    """Remove as many Gaussians as go without changing any value of the image by more than `tolerance`.

    Those that paint least go first. The bound holds for all that are removed together, not one by one: the image that
    they render with the absolute values of their colours stays under it everywhere.

    Args:
        scene: unbatched.
        tolerance: largest change of a value of the image, at least 0; 0 removes what paints nothing.
        cutoff: of the renderer.
        backend: of the renderer.

    Returns:
        The remaining scene (no graph), the number removed, and the measured largest change.

    Raises:
        TypeError, ValueError: as the renderer; a batched scene; tolerance negative or not finite.

    Example:
        >>> from kcgs import GaussianField
        >>> scene = Scene(GaussianField.random(50, (32, 48), seed=0))
        >>> with torch.no_grad():
        ...     scene.field.means[:20] += 1000.0
        >>> result = prune(scene)
        >>> result.removed, result.change
        (20, 0.0)
    """
    check_scene(scene)
    tolerance = check_number("tolerance", tolerance, 0.0)
    render = RegionSplatRenderer(cutoff=cutoff, backend=backend)
    strangers = 0
    if scene.regions is not None and scene.field.region_ids is not None:
        held = scene.regions.index_of(scene.field.region_ids) >= 0
        strangers = int((~held).sum())
        scene = _part(scene, held) if strangers else scene
    if scene.num_gaussians == 0:
        return PruneResult(_part(scene, torch.zeros(0, dtype=torch.bool)), strangers, 0.0)

    with torch.inference_mode(False), torch.enable_grad():
        order = _painted(scene, render).argsort(stable=True)
    magnitudes = _recolored(scene, scene.field.merged_colors().detach().abs())
    with torch.no_grad():
        low, high = 0, scene.num_gaussians  # the first `low` may go, the first `high + 1` may not
        while low < high:
            middle = (low + high + 1) // 2
            fits = float(render(_part(magnitudes, order[:middle])).max()) <= tolerance
            low, high = (middle, high) if fits else (low, middle - 1)
        kept = _part(scene, order[low:].sort().values)
        change = float((render(scene) - render(kept)).abs().max())
    return PruneResult(kept, strangers + low, change)


def _part(scene: Scene, mask: Tensor) -> Scene:
    return Scene(scene.field.subset(mask), scene.regions, scene.metadata)


def _recolored(scene: Scene, colors: Tensor) -> Scene:
    field = scene.field
    means, cholesky = field.means.detach(), field.cholesky.detach()
    return Scene(GaussianField(means, cholesky, colors, field.region_ids, size=field.size), scene.regions)


def _painted(scene: Scene, render: RegionSplatRenderer) -> Tensor:
    """Bound each Gaussian's largest effect on a value: no more than its colour, nor than all it paints together."""
    colors = scene.field.merged_colors().detach().clone()
    probe = _recolored(scene, torch.ones_like(colors))
    probe.field.means.requires_grad_(False)
    probe.field.cholesky.requires_grad_(False)
    render(probe).sum().backward()
    assert probe.field.colors.grad is not None
    return colors.abs().amax(-1) * probe.field.colors.grad[:, 0].clamp_max(1.0)
