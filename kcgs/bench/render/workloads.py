"""Scenes to draw, made by rule, so that anybody can draw the same."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import RegionMap, lookup_regions

# mean number of Gaussians whose 3-sigma ellipse holds a pixel
COVERAGE = 12.0


class Workload(NamedTuple):
    """A scene of N Gaussians in a label map."""

    name: str
    means: Tensor
    cholesky: Tensor
    colors: Tensor
    region_ids: Tensor
    regions: RegionMap

    def double(self) -> Workload:
        """Return the same numbers in float64."""
        return self._replace(means=self.means.double(), cholesky=self.cholesky.double(), colors=self.colors.double())


# height, width, N
STANDARD = {
    "W3": (200, 300, 20),
    "W1": (480, 854, 1_250),
    "W2": (480, 854, 7_500),
    "W4": (2160, 3840, 50_000),
}


def workload(name: str, height: int, width: int, count: int, *, spread: float | None = None) -> Workload:
    """Scatter `count` Gaussians of random shape over six regions: five blocks and a disc.

    Args:
        name: for the tables.
        height: pixels.
        width: pixels.
        count: N.
        spread: standard deviation in pixels; None: such that the mean coverage is 12.
    """
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    sigma = math.sqrt(height * width * COVERAGE / (count * 9 * math.pi)) if spread is None else spread
    means = uniform(count, 2) * torch.tensor([width, height])
    slant = 0.3 * torch.randn(count, generator=generator)
    cholesky = sigma * torch.stack([0.5 + uniform(count), slant, 0.5 + uniform(count)], -1)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    blocks = (x * 3 // width + 3 * (y * 2 // height)) % 5
    disc = (x - width / 2) ** 2 + (y - height / 2) ** 2 < (height / 4) ** 2
    labels = torch.where(disc, 5, blocks)
    return Workload(
        name, means, cholesky, uniform(count, 3), lookup_regions(means, labels), RegionMap.from_labels(labels)
    )


def standard(name: str) -> Workload:
    """Make one of the standard workloads."""
    return workload(name, *STANDARD[name])
