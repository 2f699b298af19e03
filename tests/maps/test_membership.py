"""Membership of hard and soft contours: the definition, and the kernels; test_tiles.py has its tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from kcgs import RegionMap
from kcgs.functional import region_splat

from .label_maps import blobs, membership_of

PAIRS: dict[tuple[int, int], float] = {(0, 1): 0.7, (1, 2): 2.0, (0, 3): 1.1, (2, 3): 0.7}
SIZE = (36, 60)


def width_of_pixels(labels: Any, widths: dict[tuple[int, int], float]) -> Any:
    """Width of each pixel by definition: that of the nearest contour, by the regions on its two sides."""
    height, width = labels.shape
    across = {}
    for y, x in np.ndindex(labels.shape):
        for v, u in ((y - 1, x), (y, x - 1), (y, x + 1), (y + 1, x)):
            if 0 <= v < height and 0 <= u < width and labels[v, u] != labels[y, x]:
                across.setdefault((y, x), labels[v, u])
    touches = np.zeros(labels.shape, bool)
    touches[tuple(zip(*across, strict=True))] = True
    rows, cols = ndimage.distance_transform_edt(~touches, return_distances=False, return_indices=True)
    sigma = np.zeros(labels.shape)
    for y, x in np.ndindex(labels.shape):
        nearest = rows[y, x], cols[y, x]
        other = labels[nearest] if labels[nearest] != labels[y, x] else across[nearest]
        sigma[y, x] = widths.get(tuple(sorted((int(labels[y, x]), int(other)))), 0.0)
    return sigma


def blur(labels: Tensor, sigma: Any, region: int) -> Tensor:
    """Blur of [M = region] with the width of each pixel."""
    inside = (labels == region).double().numpy()
    weights = inside.copy()
    for width in set(np.unique(sigma)) - {0.0}:
        radius = math.ceil(4 * width)
        blurred, ones = (
            ndimage.gaussian_filter(a, width, mode="constant", radius=radius) for a in (inside, 0 * inside + 1)
        )
        weights = np.where(sigma == width, blurred / ones, weights)
    return torch.from_numpy(weights)


@pytest.mark.parametrize("softness", [0.9, PAIRS], ids=["one", "pairs"])
def test_definition(softness: Any) -> None:
    labels = blobs(SIZE)
    membership = membership_of(RegionMap(labels, softness))
    sigma = width_of_pixels(labels.numpy(), PAIRS) if softness is PAIRS else np.full(labels.shape, softness)
    assert set(np.unique(sigma)) == ({0.0, 0.7, 1.1, 2.0} if softness is PAIRS else {0.9})
    for region in range(4):
        expected = blur(labels, sigma, region)
        assert (membership.weights(0, region, torch.float64) - expected).abs().max() < 1e-12


def test_contours_without_a_width_are_hard() -> None:
    labels = (torch.arange(60) // 20).expand(20, 60)  # 0 and 2 do not touch
    assert membership_of(RegionMap(labels, {(0, 2): 3.0})).radius == 0


def test_batch_with_a_map_of_one_region() -> None:
    maps = torch.stack([blobs(SIZE), torch.ones(SIZE).long()])
    membership = membership_of(RegionMap(maps, {(0, 1): 0.7, (1, 2): 1.0}))
    assert torch.equal(membership.weights(1, 1, torch.float64), torch.ones(SIZE).double())


def test_kernels_agree_on_widths_of_pairs() -> None:
    regions = RegionMap(blobs((40, 70), grain=5), PAIRS)
    random = torch.rand(60, 8, generator=torch.Generator().manual_seed(3))
    gaussians = random[:, :2] * torch.tensor([70, 40]), 0.5 + 3 * random[:, 2:5], random[:, 5:8]
    results = []
    for backend in ("reference", "tiled", "cpu"):
        leaves = [t.clone().requires_grad_() for t in gaussians]
        image = region_splat(*leaves, torch.arange(60) % 4, regions, cutoff=0.0, backend=backend)
        (image * torch.linspace(-1, 2, image.numel()).view_as(image)).sum().backward()
        results.append([image.detach(), *(leaf.grad for leaf in leaves)])
    for result in results[1:]:
        for value, expected in zip(result, results[0], strict=True):
            assert expected.std() > 0.1
            assert (value - expected).abs().max() < 1e-5 * max(1.0, float(expected.abs().max()))
