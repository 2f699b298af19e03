"""Small scenes and label maps for all tests of the codec."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kcgs import GaussianField, RegionMap, Scene
from kcgs.codec import encode

GOLDEN = Path(__file__).parent / "golden.kcgs"


def make_scene(
    count: int = 60, size: tuple[int, int] = (24, 36), regions: int = 3, channels: int = 3, seed: int = 0
) -> Scene:
    """Gaussians of all sizes, angles and strengths, some outside the image, over stripes with curved borders."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    height, width = size
    means = (1.4 * uniform(count, 2) - 0.2) * torch.tensor([width, height])
    scales = 0.3 * 40.0 ** uniform(count, 2)
    angle = math.pi * uniform(count)
    a, b = scales.unbind(-1)
    xx = (a * angle.cos()) ** 2 + (b * angle.sin()) ** 2
    xy = (a**2 - b**2) * angle.cos() * angle.sin()
    l11 = xx.sqrt()
    cholesky = torch.stack([l11, xy / l11, a * b / l11], -1)
    colors = (2 * uniform(count, channels) - 1) * 3.0 ** (-3 * uniform(count, 1))
    if regions == 1:
        return Scene(GaussianField(means, cholesky, colors, size=size))
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    stripe = (column + 3 * torch.sin(row / 5.0)) * regions / width
    labels = 5 + 7 * stripe.long().clamp(0, regions - 1)
    ids = labels.unique()[torch.randint(regions, (count,), generator=generator)]
    pairs = labels.unique().tolist()
    widths = {(pairs[i], pairs[i + 1]): 0.25 * (i % 5) for i in range(regions - 1)}
    return Scene(GaussianField(means, cholesky, colors, ids, size=size), RegionMap(labels, widths))


def make_labels(seed: int, size: tuple[int, int] = (120, 160), count: int = 6) -> NDArray[np.int64]:
    """Overlapping discs, from integers alone."""
    rng = np.random.RandomState(seed)
    y, x = np.mgrid[: size[0], : size[1]]
    labels = np.zeros(size, np.int64)
    for region in range(1, count):
        cy, cx, radius = rng.randint(size[0]), rng.randint(size[1]), rng.randint(5, 40)
        labels[(y - cy) ** 2 + (x - cx) ** 2 < radius**2] = region
    return labels


@pytest.fixture
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def data() -> bytes:
    """The file of `scene`."""
    return encode(make_scene())
