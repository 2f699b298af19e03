"""Removal of the Gaussians with the lowest impact on the render."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs._check import check_count
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.kernels import check_backend
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField, used_rows
from kcgs.optim import Gaussians, Renderer, draft_cutoff

from .checks import regions_of
from .state import FitState


def lowest_impact(
    field: GaussianField, num_gaussians: int, regions: RegionMap | Tensor | None = None, *, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    r"""Find the Gaussians whose removal changes the render least, for :meth:`kcgs.optim.GaussianAdam.keep`.

    Convention: the impact of Gaussian i is :math:`|c_i|^2 \langle g_i, g_i \rangle / (1 + \sum_j o_{ij})`. The overlap
    :math:`o_{ij}` is the normalised inner product of both Gaussians with half their covariances: 1 for identical
    Gaussians, near 0 for distant ones. Only the half of the Gaussians with more energy count as j, since the others may
    be removed too; black Gaussians never count. The remaining colours take one gradient step, of the best length,
    towards the render of the removed Gaussians; it is scaled by the energy and overlaps of each Gaussian.

    Args:
        field: N Gaussians of an image, or of each image of a batch, without opacities.
        num_gaussians: how many to remove from each image, from 0 to N.
        regions: the RegionMap or label map of the field's size, if Gaussians are confined; a batch has one for all
            images or one for each.
        backend: as in :func:`kcgs.functional.region_splat`.

    Returns:
        A mask of the Gaussians to remove, boolean :math:`(N)` or :math:`(B, N)`, and new colours of all Gaussians,
        :math:`(N, C)` or :math:`(B, N, C)`, which make up for the removal.

    Raises:
        TypeError: no field, or a number that is not whole.
        ValueError: a field with opacities, a number above N, maps of another size or number, or a map for Gaussians
            without ids.

    Example:
        >>> field = GaussianField.random(20, (16, 24), seed=0)
        >>> mask, colors = lowest_impact(field, 5)
        >>> int(mask.sum()), colors.shape
        (5, torch.Size([20, 3]))
    """
    gaussians, renderer = check_gaussians(field, regions, backend)
    if field.opacities is not None:
        raise InvalidArgument("field", "without opacities: call field.without_opacities()", "opacities")
    count = check_count("num_gaussians", num_gaussians, 0, field.num_gaussians)
    return lowest_weighted_impact(renderer, gaussians, count, torch.ones_like(gaussians.means[..., 0]))


def check_gaussians(
    field: GaussianField, regions: RegionMap | Tensor | None, backend: str
) -> tuple[Gaussians, Renderer]:
    """Return the Gaussians of a field, and a renderer with the map that confines them."""
    if not isinstance(field, GaussianField):
        raise InvalidArgumentType("field", "a GaussianField", type(field).__name__)
    map_of_field = regions_of(field.size, regions, field.num_images)
    if (map_of_field is None) != (field.region_ids is None):
        raise InvalidArgument("regions", "given where the field has region ids, and only there", regions)
    return Gaussians.of(field), Renderer(field.size, map_of_field, backend=check_backend(backend))


@torch.no_grad()
def lowest_weighted_impact(
    renderer: Renderer, gaussians: Gaussians, count: int, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Do what `lowest_impact` does, with the squared error weighted for each Gaussian, (N,) or (B, N)."""
    _, cholesky, colors, _ = gaussians

    def products(cholesky: Tensor, colors: Tensor) -> Tensor:
        return renderer.inner_products(gaussians._replace(cholesky=cholesky, colors=colors))

    area = math.pi * cholesky[..., :1] * cholesky[..., 2:]
    energy = weight * colors.square().sum(-1) * area[..., 0]
    num_unused = (~used_rows(colors)).sum(-1, keepdim=True)
    is_strong = ~_lowest(energy, num_unused + (energy.shape[-1] - num_unused) // 2)
    norm, factors = (0.5 * area).rsqrt(), is_strong[..., None].to(colors)
    overlaps = norm * products(cholesky / math.sqrt(2.0), norm * factors)
    crowding = 1.0 + (overlaps - factors).clamp_min(0.0)
    removed = _lowest(energy / crowding[..., 0], count)
    removed_products = products(cholesky, colors * removed[..., None])
    step = removed_products / (area * crowding) * ~removed[..., None]
    # inner products of the step's render: with itself, and with the removed render
    square = (step * products(cholesky, step)).sum((-2, -1), keepdim=True)
    length = (step * removed_products).sum((-2, -1), keepdim=True) / square.clamp_min(torch.finfo(step.dtype).tiny)
    return removed, colors + length * step


def _lowest(values: Tensor, count: int | Tensor) -> Tensor:
    """Mark the `count` lowest values of each image, an int or (..., 1); among equal values the first."""
    order, places = values.argsort(stable=True), torch.arange(values.shape[-1], device=values.device)
    return torch.zeros_like(values, dtype=torch.bool).scatter_(-1, order, (places < count).expand_as(order))


@torch.no_grad()
def remove_gaussians(state: FitState, count: int) -> None:
    """Remove the `count` Gaussians with the lowest impact; none for a count of 0 or less."""
    if count <= 0:
        return
    gaussians, cutoff = Gaussians.of(state.field), draft_cutoff(state.problem.config.cutoff)
    renderer, weight = state.renderer._replace(cutoff=cutoff), state.objective.weigh(gaussians)
    removed, colors = lowest_weighted_impact(renderer, gaussians, count, weight)
    state.field.colors.data.copy_(colors)
    state.optimizer.keep(state.field, ~removed)
