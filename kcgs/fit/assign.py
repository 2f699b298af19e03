"""Region ids while centres move."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs.functional import RegionMap, lookup_regions


def refresh_ids(means: Tensor, ids: Tensor | None, regions: RegionMap) -> Tensor:
    """Read the ids again under the centres (the paper's warm-up), but leave no region without its last Gaussian.

    A region that lost every Gaussian would stay black for good, since nothing outside it feels its error.

    Args:
        means: centres in pixels, (N, 2).
        ids: the present ids, (N,); None: there are none.
        regions: the map.
    """
    fresh = lookup_regions(means, regions.labels)
    if ids is None:
        return fresh
    left = torch.zeros(regions.num_regions, dtype=torch.bool, device=fresh.device)
    left[regions.index_of(fresh)] = True
    return torch.where(left[regions.index_of(ids)], fresh, ids)
