"""Membership of hard and soft contours: the definition, its tables, the kernels."""

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
from kcgs.maps import Membership
from kcgs.maps.nearest import spread
from kcgs.maps.table import full_map

from .label_maps import blobs, membership_of

Widths = float | dict[tuple[int, int], float]
PAIRS: dict[tuple[int, int], float] = {(0, 1): 0.7, (1, 2): 2.0, (0, 3): 1.1, (2, 3): 0.7}
SIZE = (36, 60)


def junction(size: tuple[int, int] = SIZE) -> Tensor:
    """Three regions that meet in the middle."""
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return torch.where(y < size[0] // 2, (x > size[1] // 2).long(), 2)


def weights_of(membership: Membership) -> Tensor:
    """Dense weights of all regions of the first map, (R, H, W)."""
    return torch.stack([membership.weights(0, r, torch.float64) for r in range(membership.table.num_regions)])


def from_table(membership: Membership, batch: int = 0) -> Tensor:
    """Weights of all regions of one map, put together from the table."""
    return torch.stack(
        [full_map(membership.tiled_table, batch, region) for region in range(membership.table.num_regions)]
    )


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


@pytest.mark.parametrize("seed", [0, 1])
class TestDefinition:
    def test_pairs(self, seed: int) -> None:
        labels = blobs(SIZE, seed=seed)
        membership = membership_of(RegionMap.from_labels(labels, PAIRS))
        sigma = width_of_pixels(labels.numpy(), PAIRS)
        assert set(np.unique(sigma)) == {0.0, 0.7, 1.1, 2.0}
        for region in range(4):
            expected = blur(labels, sigma, region)
            assert (membership.weights(0, region, torch.float64) - expected).abs().max() < 1e-12

    def test_one_width(self, seed: int) -> None:
        labels = blobs(SIZE, seed=seed)
        membership = membership_of(RegionMap.from_labels(labels, 0.9))
        for region in range(4):
            expected = blur(labels, np.full(labels.shape, 0.9), region)
            assert (membership.weights(0, region, torch.float64) - expected).abs().max() < 1e-12


@pytest.mark.parametrize("softness", [0.0, 0.7, 5.0, PAIRS, {(0, 1): 0.3}])
class TestTables:
    def test_equal_the_definition(self, softness: Widths) -> None:
        maps = torch.stack([blobs((37, 53), seed=s) for s in (0, 1)])
        maps[0, :20, :18] = 3  # tiles with a region of their own
        membership = membership_of(RegionMap.from_labels(maps, softness))
        for batch in (0, 1):
            dense = [membership.weights(batch, r, torch.float64) for r in range(4)]
            assert (from_table(membership, batch) - torch.stack(dense)).abs().max() < 1e-7

    def test_sum_to_one(self, softness: Widths) -> None:
        membership = membership_of(RegionMap.from_labels(blobs(SIZE), softness))
        weights = weights_of(membership)
        assert (weights.sum(0) - 1).abs().max() < 1e-12
        assert weights.min() >= 0
        assert ((weights > 0) & (weights < 1)).any() == (softness != 0.0)


class TestPairWidths:
    def test_junction(self) -> None:
        widths = {(0, 1): 0.0, (0, 2): 0.7, (1, 2): 2.0}
        weights = weights_of(membership_of(RegionMap.from_labels(junction(), widths)))
        apart = {pair: weights_of(membership_of(RegionMap.from_labels(junction(), w))) for pair, w in widths.items()}
        # far from the junction each contour is as if it were alone
        assert torch.equal(weights[:, :10, 20:40], apart[0, 1][:, :10, 20:40])
        assert (weights[:, :, :20] - apart[0, 2][:, :, :20]).abs().max() < 1e-12
        assert (weights[:, 12:, 45:] - apart[1, 2][:, 12:, 45:]).abs().max() < 1e-12
        assert (weights.sum(0) - 1).abs().max() < 1e-12

    def test_hard_pair_beside_a_soft_pair(self) -> None:
        labels = (torch.arange(60) // 20).expand(20, 60)
        weights = weights_of(membership_of(RegionMap.from_labels(labels, {(1, 2): 1.5})))
        assert torch.equal(weights[:, :, :30], torch.stack([labels == r for r in range(3)])[:, :, :30].double())
        soft = weights_of(membership_of(RegionMap.from_labels(labels, 1.5)))
        assert torch.equal(weights[:, :, 31:], soft[:, :, 31:])
        assert (weights[2, :, 39] > 0.3).all()

    def test_equal_widths_of_the_contours_are_one_width(self) -> None:
        labels = (torch.arange(60) // 20).expand(20, 60)  # 0 and 2 do not touch
        regions = RegionMap.from_labels(labels, {(0, 1): 0.7, (1, 2): 0.7, (0, 2): 3.0})
        assert membership_of(regions).widths == (0.7,)
        table, plain = (membership_of(r).tiled_table.tiles for r in (regions, RegionMap.from_labels(labels, 0.7)))
        assert all(torch.equal(a, b) for a, b in zip(table, plain, strict=True))

    def test_contours_without_a_width_are_hard(self) -> None:
        labels = (torch.arange(60) // 20).expand(20, 60)
        regions = RegionMap.from_labels(labels, {(0, 2): 3.0})
        assert membership_of(regions).radius == 0

    def test_batch_with_a_map_of_one_region(self) -> None:
        maps = torch.stack([junction(), torch.ones(SIZE).long()])
        membership = membership_of(RegionMap.from_labels(maps, {(0, 1): 0.7, (1, 2): 1.0}))
        assert torch.equal(membership.weights(1, 1, torch.float64), torch.ones(SIZE).double())
        assert torch.equal(from_table(membership, 1)[1], torch.ones(SIZE).double())

    def test_only_tiles_that_see_a_contour_have_masks(self) -> None:
        labels = torch.zeros(160, 160, dtype=torch.long)
        labels[:, 80:], labels[:, 144:] = 1, 2
        table = membership_of(RegionMap.from_labels(labels, {(0, 1): 0.7})).tiled_table
        assert len(table.weights) == 2 * 20
        # between 1 and 2 no pixel is soft, and their contour is a border of tiles
        assert (table.planes < 0).sum() == 80


def test_to(device: torch.device) -> None:
    regions = RegionMap.from_labels(blobs(SIZE), PAIRS)
    moved, expected = (membership_of(r).tiled_table.tiles for r in (regions.to(device), regions))
    assert all(a.device.type == device.type and torch.equal(a.cpu(), b) for a, b in zip(moved, expected, strict=True))


def test_kernels_agree_on_widths_of_pairs() -> None:
    regions = RegionMap.from_labels(blobs((40, 70), grain=5), PAIRS)
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


def test_level_of_the_nearest_contour() -> None:
    """Ties included: pixels have that of scipy's nearest pixel."""
    generator = torch.Generator().manual_seed(0)
    values = torch.randint(0, 50, (40, 13, 17), generator=generator, dtype=torch.int32)
    values[torch.rand(values.shape, generator=generator) < torch.linspace(0.5, 0.99, 40)[:, None, None]] = -1
    values[0] = -1
    nearest = np.full(values.shape, 7, np.int32)
    spread(values.numpy(), nearest)
    assert (nearest[0] == 7).all()
    for found, sources in zip(nearest[1:], values[1:].numpy(), strict=True):
        rows, cols = ndimage.distance_transform_edt(sources < 0, return_distances=False, return_indices=True)
        assert (found == sources[rows, cols]).all()
