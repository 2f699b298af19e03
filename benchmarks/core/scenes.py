"""Scenes of experiments: synthetic workloads, and fitted scenes of the zoo."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, Scene, load
from kcgs.functional import lookup_regions
from kcgs.zoo import find

# height, width, N; a pixel lies in 12 ellipses of 3 sigma on average
WORKLOADS = {"W3": (200, 300, 20), "W1": (480, 854, 1_250), "W2": (480, 854, 7_500), "W4": (2160, 3840, 50_000)}
_COVERAGE = 12.0
# 3.7, 6.3 and 11.4 Gaussians per thousand pixels; W1 has 3.0, W2 18
FITTED = ("rocket-1000", "coffee-1500", "astronaut-3000")
SIZES = ("native", "3840 wide")


def scene_of(name: str) -> Scene:
    """Make a workload, or read a scene of the zoo; "none", "hard" or "soft" behind the name are its contours."""
    name, _, contours = name.partition(" ")
    scene = workload(*WORKLOADS[name]) if name in WORKLOADS else load(find(name))
    field, regions = scene.field, scene.regions
    if contours == "none" or regions is None:
        return Scene(GaussianField(field.means, field.cholesky, field.colors, size=field.size))
    if contours == "soft" and name not in WORKLOADS:
        return scene
    return Scene(field, RegionMap.from_labels(regions.labels, 0.7 if contours == "soft" else 0.0))


def size_of(scene: Scene, size: str) -> tuple[int, int]:
    """Return height and width of one of SIZES."""
    height, width = scene.size
    return (height, width) if size == "native" else (round(3840 / width * height), 3840)


def workload(height: int, width: int, count: int) -> Scene:
    """Scatter Gaussians of about one size over five blocks and a disc."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    sigma = math.sqrt(height * width * _COVERAGE / (count * 9 * math.pi))
    means = uniform(count, 2) * torch.tensor([width, height])
    slant = 0.3 * torch.randn(count, generator=generator)
    cholesky = sigma * torch.stack([0.5 + uniform(count), slant, 0.5 + uniform(count)], -1)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    blocks = (x * 3 // width + 3 * (y * 2 // height)) % 5
    disc = (x - width / 2) ** 2 + (y - height / 2) ** 2 < (height / 4) ** 2
    labels = torch.where(disc, 5, blocks)
    field = GaussianField(means, cholesky, uniform(count, 3), lookup_regions(means, labels), size=(height, width))
    return Scene(field, RegionMap.from_labels(labels))
