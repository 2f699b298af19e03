"""Rows of fields that an optimizer adds or removes."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs.errors import InvalidArgument
from kcgs.nn import GaussianField


def check_added(field: GaussianField, added: GaussianField) -> None:
    """Validate that Gaussians may be added to a field: the same batch, channels, and optional tables."""
    if _layout(field) != _layout(added):
        raise InvalidArgument("added", _layout(field), _layout(added), verb="have")


def _layout(field: GaussianField) -> str:
    """Describe what another field must have to be added to a field."""
    *batch, _, channels = field.colors.shape
    optional = [name for name in ("region_ids", "opacities") if getattr(field, name) is not None]
    return " and ".join([f"colors ({', '.join(map(str, [*batch, 'N', channels]))})", *optional])


def check_mask(mask: Tensor, *shapes: torch.Size) -> None:
    """Validate a mask of Gaussians, which has one of several shapes."""
    if mask.dtype != torch.bool or mask.shape not in shapes:
        expected = " or ".join(str(tuple(shape)) for shape in dict.fromkeys(shapes))
        raise InvalidArgument("mask", f"boolean, {expected}", f"{mask.dtype}, {tuple(mask.shape)}")


def rows_of(field: GaussianField, mask: Tensor) -> Tensor:
    """Return the numbers of a mask's rows: (N') of a mask for all images, (B, N') of a mask for each image."""
    check_mask(mask, field.means.shape[-2:-1], field.means.shape[:-1])
    index = mask.nonzero()[:, -1]
    if mask.ndim == 1:
        return index
    counts = mask.sum(1)
    if not bool((counts == counts[0]).all()):
        raise InvalidArgument("mask", "of as many Gaussians in each image", counts.tolist())
    return index.view(len(mask), -1)


def select_rows(table: Tensor, index: Tensor, rows: int) -> Tensor:
    """Select rows, which are dimension `rows` of a table; `index` is (N',) for all images, or (B, N')."""
    if index.ndim == 1:
        return table.index_select(rows, index)
    columns = table.shape[2:]
    return table.gather(1, index.view(*index.shape, *[1] * len(columns)).expand(*index.shape, *columns))
