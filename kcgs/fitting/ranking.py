"""The order of Gaussians by their importance for a render."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs.maps import RegionMap
from kcgs.nn import GaussianField
from kcgs.optim import self_product

from .removal import check_gaussians

# more rounds are slower, and order overlapping Gaussians better
_ROUNDS = 16


@torch.no_grad()
def rank_gaussians(field: GaussianField, regions: RegionMap | Tensor | None = None, *, backend: str = "auto") -> Tensor:
    r"""Order Gaussians by importance, so that for any K the first K approximate the render well.

    Convention: Gaussians are removed from the whole render in 16 rounds. Each round removes the Gaussians whose single
    removal raises the squared error least. Gaussians that are removed later come earlier; unused rows come last.

    Args:
        field: N Gaussians of an image, or of each image of a batch.
        regions: as in :func:`lowest_impact`.
        backend: as in :func:`lowest_impact`.

    Returns:
        The row numbers, the most important first, int64, :math:`(N)` or :math:`(B, N)`.

    Raises:
        TypeError, ValueError: as :func:`lowest_impact`.

    Example:
        >>> field = GaussianField.random(20, (16, 24), seed=0)
        >>> field.colors.data[:5] = 0.0
        >>> sorted(rank_gaussians(field)[15:].tolist())
        [0, 1, 2, 3, 4]
    """
    gaussians, renderer = check_gaussians(field, regions, backend)
    colors, count = gaussians.colors, -(-field.num_gaussians // _ROUNDS)
    black, error = gaussians._replace(colors=torch.zeros_like(colors)), torch.zeros_like(renderer.render(gaussians))
    energy = self_product(gaussians.cholesky) * colors.square().sum(-1)
    order = torch.empty_like(energy[..., :0], dtype=torch.int64)
    is_left = torch.ones_like(energy, dtype=torch.bool)
    while order.shape[-1] < energy.shape[-1]:
        # colour gradients of a black render against the error: inner products of each Gaussian with the error, negated
        products = renderer.squared_error_gradients(black, error).colors
        rise = energy - 2.0 * (products * colors).sum(-1)
        rise = torch.where(energy > 0, rise, torch.finfo(rise.dtype).min).masked_fill(~is_left, torch.inf)
        rows = rise.argsort(dim=-1, stable=True)[..., : min(count, energy.shape[-1] - order.shape[-1])]
        order = torch.cat([rows.flip(-1), order], -1)
        is_next = torch.zeros_like(is_left).scatter_(-1, rows, True)
        is_left &= ~is_next
        error = error + renderer.render(gaussians._replace(colors=colors * is_next[..., None]))
    return order
