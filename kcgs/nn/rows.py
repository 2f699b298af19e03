"""Fields with other rows, or for an image of another size."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from kcgs._sizes import is_equal
from kcgs.maps import RegionMap

from .field import GaussianField


def scaled_gaussians(field: GaussianField, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return means and Cholesky factors as they are on an image of another size, with the graph."""
    means, cholesky = field.means, field.cholesky
    if is_equal(size[0], field.size[0]) and is_equal(size[1], field.size[1]):
        return means, cholesky
    # a graph for any size needs the sides as tensors
    factors = torch.stack([torch.full((), size[k], dtype=torch.float64) / field.size[k] for k in (1, 0)]).to(means)
    return means * factors, cholesky * factors[[0, 1, 1]]


def join(first: GaussianField, second: GaussianField) -> GaussianField:
    """Join two fields, both with region ids or neither, without the graph; missing opacities count as 1."""
    rows = first.means.ndim - 2

    def concatenate(a: Tensor, b: Tensor) -> Tensor:
        return torch.cat([a.detach(), b.detach()], rows)

    ids = opacities = None
    if first.region_ids is not None and second.region_ids is not None:
        ids = concatenate(first.region_ids, second.region_ids)
    if first.opacities is not None or second.opacities is not None:
        opaque = (f.means.new_ones(f.means.shape[:-1]) if f.opacities is None else f.opacities for f in (first, second))
        opacities = concatenate(*opaque)
    means, cholesky = concatenate(first.means, second.means), concatenate(first.cholesky, second.cholesky)
    return GaussianField(means, cholesky, concatenate(first.colors, second.colors), ids, opacities, size=first.size)


def used_rows(colors: Tensor) -> Tensor:
    """Return the mask of used rows, bool (..., N), by colours with opacities merged, (..., N, C).

    All images of a batch have as many rows. A row that an image does not need is unused: its colour is 0, so it paints
    nothing, and its other numbers mean nothing.
    """
    return (colors != 0).any(-1)


def clear_lost_rows(field: GaussianField, regions: RegionMap) -> GaussianField:
    """Make the rows of regions that a map lacks unused, with the map's first region; without the graph."""
    if field.region_ids is None:
        return field
    is_present = torch.isin(field.region_ids, regions.ids)
    ids, colors = torch.where(is_present, field.region_ids, regions.ids[0]), field.colors.detach()
    colors = torch.where(is_present[..., None], colors, 0.0)
    return GaussianField(field.means.detach(), field.cholesky.detach(), colors, ids, field.opacities, size=field.size)


def pad_rows(field: GaussianField, count: int, regions: RegionMap | None = None) -> GaussianField:
    """Pad a field with unused rows to `count` per image, without the graph; opacities are merged into the colours.

    The new rows have the region of the image's first Gaussian or, with a map, the map's first region. With a map, all
    Gaussians of a field without ids get the map's first region.
    """
    missing, ids = count - field.num_gaussians, field.region_ids
    means, cholesky, colors = (
        pad(table.detach(), (0, 0, 0, missing), value=fill)
        for table, fill in ((field.means, 1.0), (field.cholesky, 1.0), (field.merged_colors(), 0.0))
    )
    if regions is not None and ids is None:
        ids = regions.ids[:1].expand(means.shape[:-1])
    elif ids is not None:
        first = ids[..., :1] if regions is None else regions.ids[:1]
        ids = torch.cat([ids, first.expand(*ids.shape[:-1], missing)], -1)
    return GaussianField(means, cholesky, colors, ids, size=field.size)


def reorder_rows(field: GaussianField, order: Tensor) -> GaussianField:
    """Return the rows in another order, (N,) or (B, N), without the graph; opacities are merged into the colours."""
    index = order[..., None]
    means, cholesky, colors = (
        table.detach().gather(-2, index.expand(*order.shape, table.shape[-1]))
        for table in (field.means, field.cholesky, field.merged_colors())
    )
    ids = None if field.region_ids is None else field.region_ids.gather(-1, order)
    return GaussianField(means, cholesky, colors, ids, size=field.size)
