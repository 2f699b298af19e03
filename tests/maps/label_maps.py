"""Label maps for tests, and their memberships."""

from __future__ import annotations

import torch
from torch import Tensor

from kcgs import RegionMap
from kcgs.maps import Membership, membership_at, table_and_size


def blobs(size: tuple[int, int] = (45, 70), regions: int = 4, seed: int = 0, grain: int = 9) -> Tensor:
    """Return regions with curved contours."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(1, regions, *size, generator=generator)
    return torch.nn.functional.avg_pool2d(noise, grain, stride=1, padding=grain // 2).argmax(1)[0]


def membership_of(regions: RegionMap) -> Membership:
    """Return the membership of a map at its size, by its definition."""
    return membership_at(*table_and_size(regions))
