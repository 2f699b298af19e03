"""Contours that move: where to, how far, what they must not lose."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, Scene
from kcgs.fitting.contour_energy import bounding_boxes, disc, index_map, region_costs
from kcgs.fitting.contour_loops import MapEnergy, piece_energy
from kcgs.fitting.contour_moves import refine_contours
from kcgs.functional import edge_band, region_splat

WIDE = 1e4  # standard deviation in pixels: a Gaussian that is constant over the image


def flat_field(colors: dict[int, list[float]], size: tuple[int, int]) -> GaussianField:
    """One constant colour for each region."""
    count = len(colors)
    means = torch.tensor([[size[1] / 2, size[0] / 2]]).repeat(count, 1)
    factors = torch.tensor([[WIDE, 0.0, WIDE]]).repeat(count, 1)
    return GaussianField(means, factors, torch.tensor([*colors.values()]), torch.tensor([*colors]), size=size)


def step(edge: int, size: tuple[int, int] = (24, 40)) -> Tensor:
    return (torch.arange(size[1]) >= edge).long().expand(size).clone()


def noisy_problem(seed: int, dtype: torch.dtype = torch.float32) -> tuple[GaussianField, Tensor, RegionMap]:
    """Blocky regions with ids that have gaps, Gaussians at random, and an image of noise."""
    draw = torch.Generator().manual_seed(seed)
    size = (20 + seed % 7, 33 - seed % 5)
    coarse = torch.randint(0, 2 + seed % 5, (5, 6), generator=draw) * 3 + 1
    rows, columns = (torch.arange(n) * m // n for n, m in zip(size, (5, 6), strict=True))
    regions = RegionMap(coarse[rows][:, columns], (seed % 3) * 0.5)
    channels = 1 + seed % 4
    field = GaussianField.random(30, size, channels=channels, regions=regions, seed=seed, dtype=dtype)
    image = torch.rand(channels, *size, generator=draw)
    for axis in (1, 2):  # some structure in the noise
        image = (image + image.roll(1, axis) + image.roll(2, axis)) / 3
    return field, image.to(dtype), regions


def dense_energy(field: GaussianField, image: Tensor, regions: RegionMap, weight: float, sigma: float) -> float:
    """The formula, pixel by pixel."""
    _, height, width = image.shape
    labels, total = regions.labels, 0.0
    reach = math.ceil(4 * sigma)
    for region in regions.ids.tolist():
        members = field.region_ids == region
        rendered = region_splat(field.means[members], field.cholesky[members], field.colors[members], size=field.size)
        error = (rendered - image).square().mean(0).detach().double().numpy()
        for y, x in (labels == region).nonzero().tolist():
            weights = norm = 0.0
            for v in range(max(0, y - reach), min(height, y + reach + 1)):
                for u in range(max(0, x - reach), min(width, x + reach + 1)):
                    tap = math.exp(-0.5 * ((v - y) ** 2 + (u - x) ** 2) / sigma**2)
                    weights, norm = weights + tap * error[v, u], norm + tap
            around = labels[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
            total += weights / norm + weight / 8 * int((around != region).sum())
    return total + weight * 0.3 * curvature(labels)


def curvature(labels: Tensor) -> int:
    """Squares of how many more of the 12 pixels around each one differ from it than equal it."""
    excess, padded = torch.zeros_like(labels), torch.nn.functional.pad(labels, (2,) * 4, value=-1)
    for y, x in np.ndindex(5, 5):
        other = padded[y : y + len(labels), x : x + labels.shape[1]]
        if 0 < (y - 2) ** 2 + (x - 2) ** 2 <= 4:
            excess += (other != -1) * (1 - 2 * (other == labels).long())
    return int(excess.clamp(min=0).square().sum())


def contour_energy(scene: Scene, image: Tensor, length_weight: float = 0.003, blur: float = 0.7) -> float:
    """What `refine_contours` lowers, by its parts."""
    regions = scene.regions
    index = index_map(regions, regions.labels)
    boxes = bounding_boxes(index, regions.num_regions, 0)
    with torch.no_grad():
        costs = region_costs(scene, image, boxes, 1, blur, "auto")
    labels, none = np.pad(index, 1, constant_values=-1), np.zeros(0, np.int32)
    # each of eight neighbours of the same label saves half a pair
    energy, limit = MapEnergy(labels.ravel(), costs, length_weight / 8, disc(2, labels.shape[1])), (none, none)
    energies = [piece_energy(energy, limit, np.flatnonzero(labels == r), r) for r in range(regions.num_regions)]
    height, width = index.shape
    pairs = 4 * height * width - 3 * (height + width) + 2
    return float(sum(energies)) + length_weight / 4 * pairs + length_weight * 0.3 * curvature(regions.labels)


class TestEnergy:
    def test_is_the_formula(self) -> None:
        field, image, regions = noisy_problem(1, torch.float64)
        got = contour_energy(Scene(field, regions), image, length_weight=0.02, blur=0.7)
        assert got == pytest.approx(dense_energy(field, image, regions, 0.02, 0.7), rel=1e-9)

    def test_length_of_known_contours(self) -> None:
        field, image = flat_field({0: [0.0], 1: [0.0]}, (24, 40)), torch.zeros(1, 24, 40)
        straight = contour_energy(Scene(field, RegionMap(step(9))), image, length_weight=1.0)
        assert straight == pytest.approx((24 + 2 * 23) / 4)
        alone = torch.zeros(24, 40, dtype=torch.long)
        alone[5, 5] = 1
        energy = contour_energy(Scene(field, RegionMap(alone)), image, length_weight=1.0)
        assert energy == pytest.approx(2.0 + 0.3 * 12**2)

    @pytest.mark.parametrize("seed", range(6))
    def test_never_rises(self, seed: int) -> None:
        field, image, regions = noisy_problem(seed, (torch.float32, torch.float64)[seed % 2])
        settings = {"length_weight": (0.0, 0.003, 0.1)[seed % 3], "blur": (0.0, 0.7, 1.5)[seed % 3]}
        before = contour_energy(Scene(field, regions), image, **settings)
        # without pieces given away no sweep may raise it; with it the whole may not, and the sweeps gain far more
        for smallest, reach in ((1, 1), (1, 2), (12, 3)):
            refined = refine_contours(Scene(field, regions), image, smallest=smallest, reach=reach, **settings)
            after = contour_energy(Scene(field, refined), image, **settings)
            assert after <= before * (1 + 1e-6)
            assert refined is not regions and after < before

    def test_no_single_change_would_lower_it(self) -> None:
        field, image, regions = noisy_problem(1, torch.float64)
        refined = refine_contours(Scene(field, regions), image, smallest=1, max_distance=None, sweeps=100, reach=1)
        lowest = contour_energy(Scene(field, refined), image)
        touched = edge_band(refined.labels, 1).nonzero()
        for y, x in touched[::15].tolist():
            for region in refined.labels[max(0, y - 1) : y + 2, x].unique().tolist():
                labels = refined.labels.clone()
                labels[y, x] = region
                # a region's last pixel is not up for exchange
                if len(labels.unique()) == refined.num_regions:
                    assert contour_energy(Scene(field, labels), image) >= lowest - 1e-9


class TestMoves:
    @pytest.mark.parametrize(
        ("start", "edge", "settings", "calls", "end"),
        [
            (10, 12, {}, 1, 12),
            (14, 12, {}, 1, 12),
            (12, 20, {"anchor": step(12)}, 4, 15),
            (12, 30, {"max_distance": None}, 1, 18),  # reach times sweeps
            (12, 30, {"max_distance": None}, 4, 30),
        ],
    )
    def test_towards_the_edge(self, start: int, edge: int, settings: dict[str, Any], calls: int, end: int) -> None:
        field, regions = flat_field({0: [0.0], 1: [1.0]}, (24, 40)), RegionMap(step(start), 0.7)
        for _ in range(calls):
            regions = refine_contours(Scene(field, regions), step(edge).float()[None], **settings)
        assert torch.equal(regions.labels, step(end)) and regions.softness == 0.7

    def test_a_map_that_is_right_stays(self) -> None:
        regions = RegionMap(step(12))
        field = flat_field({0: [0.0], 1: [1.0]}, (24, 40))
        assert refine_contours(Scene(field, regions), step(12).float()[None]) is regions

    def test_only_labels_within_reach(self) -> None:
        # the best colour for the middle is that of a region that is far from it
        labels = torch.zeros(20, 40, dtype=torch.long)
        labels[:, 10:20], labels[:, 20:30], labels[:, 30:] = 1, 2, 3
        image = torch.full((1, 20, 40), 0.5)
        field = flat_field({0: [0.2], 1: [0.3], 2: [0.4], 3: [0.5]}, (20, 40))
        refined = refine_contours(Scene(field, labels), image, max_distance=None, reach=1, sweeps=2)
        assert refined.labels[5].tolist() == [0] * 8 + [1] * 10 + [2] * 10 + [3] * 12

    def test_a_region_without_gaussians_is_black(self) -> None:
        field = flat_field({1: [1.0]}, (24, 40))
        refined = refine_contours(Scene(field, RegionMap(step(10))), step(12).float()[None])
        assert torch.equal(refined.labels, step(12))


class TestShape:
    def test_specks_that_come_up_are_given_away(self) -> None:
        image = step(12).float()[None].clone()
        image[:, 4:6, 13:15] = 0.0  # of the other colour, away from the contour
        image[:, 14:16, 9:11] = 1.0
        field, regions = flat_field({0: [0.0], 1: [1.0]}, (24, 40)), RegionMap(step(12))
        kept = refine_contours(Scene(field, regions), image, blur=0.0, smallest=1)
        assert (kept.labels != step(12)).sum() == 8
        refined = refine_contours(Scene(field, RegionMap(step(11))), image, blur=0.0)
        assert torch.equal(refined.labels, step(12))

    def test_pieces_that_were_small_stay(self) -> None:
        labels = step(12)
        labels[4:6, 30:32] = 2
        image = step(14).float()[None].clone()
        image[:, 4:6, 30:33] = 0.5
        field = flat_field({0: [0.0], 1: [1.0], 2: [0.5]}, (24, 40))
        want = step(14)
        want[4:6, 30:33] = 2
        assert torch.equal(refine_contours(Scene(field, labels), image, blur=0.0).labels, want)

    @pytest.mark.parametrize("distance", [3.0, None])
    def test_no_region_vanishes(self, distance: float | None) -> None:
        labels = step(20)
        labels[3, 3], labels[10:12, 8], labels[15:19, 30:36] = 5, 6, 9
        regions = RegionMap(labels, 0.7)
        # each would be better off without 5, 6 and 9
        field = flat_field({0: [0.0], 1: [1.0], 5: [9.0], 6: [-9.0], 9: [7.0]}, (24, 40))
        for _ in range(3):
            refined = refine_contours(Scene(field, regions), step(20).float()[None], max_distance=distance)
            kept = [int((refined.labels == region).sum()) for region in (5, 6, 9)]
            assert kept == [1, 2, 12]
            assert refined.labels[3, 3] == 5 and (refined.labels[10:12, 8] == 6).all()

    def test_bumps_cost_and_thin_legs_do_not(self) -> None:
        labels = step(12)
        labels[:, 24:26], image = 0, 0.1 * step(12).float()[None]
        image[..., 24:26] = 0.0
        bumpy = image.clone()
        bumpy[:, 3::6, 12] = 0.0
        field = flat_field({0: [0.0], 1: [0.1]}, (24, 40))
        for start in (image, bumpy):
            regions = RegionMap((start[0] > 0).long())
            assert torch.equal(refine_contours(Scene(field, regions), bumpy, blur=0.0).labels, labels)

    def test_one_region_returns_the_map(self) -> None:
        regions = RegionMap(torch.full((24, 40), 7))
        assert refine_contours(Scene(flat_field({7: [0.3]}, (24, 40)), regions), torch.rand(1, 24, 40)) is regions

    @pytest.mark.parametrize("size", [(1, 2), (9, 1)])
    def test_tiny_images(self, size: tuple[int, int]) -> None:
        labels = torch.zeros(size, dtype=torch.long)
        labels[-1, -1] = 1
        refined = refine_contours(
            Scene(flat_field({0: [0.0], 1: [1.0]}, size), RegionMap(labels)), torch.zeros(1, *size)
        )
        assert torch.equal(refined.labels, labels)

    def test_widths_of_pairs(self) -> None:
        labels = torch.zeros(24, 40, dtype=torch.long)
        labels[:, 12:16], labels[:, 16:], labels[20:, :12] = 1, 2, 3
        image = torch.zeros(1, 24, 40)
        image[..., 14:] = 1.0
        image[:, 10:14, 12:14] = 1.0  # here 2 reaches 0, through 1
        field = flat_field({0: [0.0], 1: [0.0], 2: [1.0], 3: [0.0]}, (24, 40))
        regions = RegionMap(labels, {(0, 1): 0.5, (1, 2): 1.5})
        refined = refine_contours(Scene(field, regions), image, max_distance=5, blur=0.0, length_weight=1e-4)
        assert (refined.labels[10:14, 11:13] == torch.tensor([0, 2])).all()
        assert dict(refined.softness) == {(0, 1): 0.5, (0, 2): 1.0, (1, 2): 1.5}
