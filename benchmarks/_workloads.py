"""Scenes that anybody can render too: made by rule, and fitted ones of the zoo."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs.functional import RegionMap, lookup_regions, scale_rotation_to_cholesky
from kcgs.nn import GaussianField
from kcgs.nn.field import scaled
from kcgs.scene import Scene, load
from kcgs.zoo import find

# mean number of Gaussians whose 3-sigma ellipse holds a pixel
COVERAGE = 12.0
NEEDLES_SIZE = (96, 128)
# height, width, N
STANDARD = {"W3": (200, 300, 20), "W1": (480, 854, 1_250), "W2": (480, 854, 7_500), "W4": (2160, 3840, 50_000)}
# of the zoo: 3.7, 6.3 and 11.4 Gaussians per thousand pixels; W1 has 3.0, W2 18
FITTED = ("rocket-1000", "coffee-1500", "astronaut-3000")
WIDE = "3840 wide"
SIZES = ("native", "2x", WIDE)


def workload(height: int, width: int, count: int, *, spread: float | None = None) -> Scene:
    """Scatter Gaussians, `spread` pixels wide (None: for a mean coverage of 12), over five blocks and a disc."""
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
    region_ids = lookup_regions(means, labels)
    field = GaussianField(means, cholesky, uniform(count, 3), region_ids, size=(height, width))
    return Scene(field, RegionMap.from_labels(labels))


def standard(name: str) -> Scene:
    """Make one of the standard workloads, or read a fitted scene: its name in the zoo, "soft" or "hard" behind it."""
    if name in STANDARD:
        return workload(*STANDARD[name])
    fitted, contours = name.split()
    scene = load(find(fitted))
    assert scene.regions is not None
    return scene if contours == "soft" else Scene(scene.field, RegionMap.from_labels(scene.regions.labels))


def target_size(scene: Scene, size: str) -> tuple[int, int]:
    """Return height and width of one of SIZES."""
    height, width = scene.size
    factor = 3840 / width if size == WIDE else {"native": 1, "2x": 2}[size]
    return round(factor * height), round(factor * width)


def resized(scene: Scene, size: tuple[int, int]) -> Scene:
    """Scale the Gaussians and sample the map anew: once, for all images of that size."""
    field, regions = scene.field, scene.regions
    means, cholesky, colors = (t.detach() for t in (*scaled(field, size), field.merged_colors()))
    region_ids = None if regions is None else field.region_ids
    placed = GaussianField(means, cholesky, colors, region_ids, size=size)
    return Scene(placed, None if regions is None else regions.resize(size))


def needles(sigma: float, anisotropy: float, count: int = 37) -> Scene:
    """Make Gaussians of one shape turned from 0 to pi, the singular angles among them; float32."""
    angle = torch.linspace(0, math.pi, count, dtype=torch.float64)
    scales = torch.tensor([sigma * anisotropy, sigma], dtype=torch.float64).expand(count, 2)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 2, generator=generator) * torch.tensor([NEEDLES_SIZE[1], NEEDLES_SIZE[0]])
    cholesky = scale_rotation_to_cholesky(scales, angle).float()
    return Scene(GaussianField(means, cholesky, torch.ones(count, 1), size=NEEDLES_SIZE))
