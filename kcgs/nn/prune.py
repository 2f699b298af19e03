"""Leave out the Gaussians that the image does not need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import RegionMap

from .field import GaussianField
from .renderer import RegionSplatRenderer


class PruneResult(NamedTuple):
    """What is left, how many went, and by how much the image changed."""

    field: GaussianField
    removed: int
    change: float


def prune(
    field: GaussianField,
    regions: RegionMap | Tensor | None = None,
    tolerance: float = 1e-3,
    *,
    cutoff: float = 1e-4,
    backend: str = "auto",
) -> PruneResult:
    """Remove as many Gaussians as go without changing any value of the image by more than `tolerance`.

    Those that paint least go first. The bound holds for all that are removed together, not one by one: the image that
    they render with the absolute values of their colours stays under it everywhere.

    Args:
        field: unbatched.
        regions: what the field is rendered with.
        tolerance: largest change of a value of the image, at least 0; 0 removes what paints nothing.
        cutoff: of the renderer.
        backend: of the renderer.

    Returns:
        The remaining field (no graph), the number removed, and the measured largest change.

    Raises:
        TypeError, ValueError: as the renderer; a batched field; tolerance negative or not finite.

    Example:
        >>> field = GaussianField.random(50, (32, 48), seed=0)
        >>> with torch.no_grad():
        ...     field.means[:20] += 1000.0
        >>> result = prune(field)
        >>> result.removed, result.change
        (20, 0.0)
    """
    if field.means.ndim != 2:
        raise ValueError(f"field must not be batched; got means of shape {tuple(field.means.shape)}")
    if not 0.0 <= tolerance < float("inf"):
        raise ValueError(f"tolerance must be at least 0 and finite; got {tolerance!r}")
    render = RegionSplatRenderer(cutoff=cutoff, backend=backend)
    if len(field) == 0:
        return PruneResult(field.subset(torch.zeros(0, dtype=torch.bool)), 0, 0.0)

    with torch.inference_mode(False), torch.enable_grad():
        order = _painted(field, regions, render).argsort(stable=True)
    magnitudes = GaussianField(
        field.means.detach(), field.cholesky.detach(), field.merged_colors().detach().abs(), field.region_ids,
        size=field.size,
    )  # fmt: skip
    with torch.no_grad():
        low, high = 0, len(field)  # the first `low` may go, the first `high + 1` may not
        while low < high:
            middle = (low + high + 1) // 2
            fits = float(render(magnitudes.subset(order[:middle]), regions).max()) <= tolerance
            low, high = (middle, high) if fits else (low, middle - 1)
        kept = field.subset(order[low:].sort().values)
        change = float((render(field, regions) - render(kept, regions)).abs().max())
    return PruneResult(kept, low, change)


def _painted(field: GaussianField, regions: RegionMap | Tensor | None, render: RegionSplatRenderer) -> Tensor:
    """Bound each Gaussian's largest effect on a value: no more than its colour, nor than all it paints together."""
    means, cholesky, colors = (t.detach().clone() for t in (field.means, field.cholesky, field.merged_colors()))
    ids = None if field.region_ids is None else field.region_ids.clone()
    probe = GaussianField(means, cholesky, torch.ones_like(colors), ids, size=field.size)
    probe.means.requires_grad_(False)
    probe.cholesky.requires_grad_(False)
    render(probe, regions).sum().backward()
    assert probe.colors.grad is not None
    return colors.abs().amax(-1) * probe.colors.grad[:, 0].clamp_max(1.0)
