"""Proposals: the gain, confinement, suppression, and that the error falls."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from torch import Tensor

from kcgs.fitting.pursuit import _search, propose
from kcgs.functional import RegionMap, lookup_regions, region_splat
from kcgs.nn import GaussianField

SIGMAS = (0.7, 1.13, 1.8, 2.9, 4.6, 7.5)


def noise(channels: int, size: tuple[int, int], smooth: int = 3, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(1, channels, *size, generator=generator)
    return torch.nn.functional.avg_pool2d(values, smooth, 1, smooth // 2, count_include_pad=False)[0]


def halves(size: tuple[int, int]) -> RegionMap:
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return RegionMap.from_labels(torch.where(x + y // 3 < size[1] // 2, 4, 9))


def tensors(field: GaussianField) -> list[Tensor]:
    ids = [] if field.region_ids is None else [field.region_ids]
    return [field.means.detach(), field.cholesky.detach(), field.colors.detach(), *ids]


def render(field: GaussianField, regions: RegionMap | None) -> Tensor:
    means, cholesky, colors, *ids = tensors(field)
    return region_splat(means, cholesky, colors, *ids, regions, size=field.size, cutoff=0, backend="reference")


def dense_gain(residual: Tensor, mask: Tensor, x: float, y: float, sigma: float) -> float:
    rows, cols = torch.meshgrid(*(torch.arange(n) + 0.5 for n in mask.shape), indexing="ij")
    weight = torch.exp(-0.5 * ((cols - x) ** 2 + (rows - y) ** 2) / sigma**2) * mask
    return float(((weight * residual).sum((1, 2)) ** 2).sum() / (weight**2).sum())


class TestGain:
    @pytest.mark.parametrize(("sigma", "tolerance"), [(0.7, 0.02), (1.13, 0.02), (1.8, 0.15), (2.9, 0.15), (7.5, 0.15)])
    @pytest.mark.parametrize("channels", [1, 8])
    def test_search_agrees_with_the_definition(self, sigma: float, tolerance: float, channels: int) -> None:
        # error that varies no faster than the Gaussians, as that which they are chosen for
        residual = noise(channels, (40, 52), smooth=int(4 * sigma) | 1).double()
        regions = halves((40, 52))
        candidates = _search(residual, regions.index[0].numpy(), (sigma,), 4)
        assert set(candidates.region) == {0, 1}
        for i in np.argsort(-candidates.gain)[:12]:
            mask = regions.labels == regions.ids[int(candidates.region[i])]
            expected = dense_gain(residual, mask, candidates.x[i], candidates.y[i], sigma)
            assert candidates.gain[i] == pytest.approx(expected, rel=tolerance)

    def test_finds_the_gaussian_that_is_there(self) -> None:
        mean, cholesky = torch.tensor([[20.5, 14.5]]), torch.tensor([[1.8, 0.0, 1.8]])
        color = torch.tensor([[0.6, -0.2, 0.1]])
        residual = region_splat(mean, cholesky, color, size=(32, 48))
        proposal = propose(residual, None, 1, sigmas=SIGMAS)
        assert proposal.cholesky.tolist() == cholesky.tolist()
        assert (proposal.means - mean).abs().max() <= 1
        torch.testing.assert_close(proposal.colors, color, atol=0.06, rtol=0.1)


class TestProposal:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("channels", [1, 3, 8])
    def test_shapes_and_order(self, channels: int, dtype: torch.dtype) -> None:
        residual = noise(channels, (40, 52)).to(dtype)
        proposal = propose(residual, halves((40, 52)), 15, sigmas=SIGMAS)
        assert [tuple(t.shape) for t in tensors(proposal)] == [(15, 2), (15, 3), (15, channels), (15,)]
        assert {t.dtype for t in tensors(proposal)[:3]} == {dtype}
        assert proposal.region_ids is not None and proposal.region_ids.dtype == torch.int64
        assert propose(residual, None, 3, sigmas=SIGMAS).region_ids is None

    @pytest.mark.parametrize("softness", [0.0, 0.8])
    @pytest.mark.parametrize("count", [1, 10, 60])
    def test_error_falls(self, count: int, softness: float) -> None:
        residual = noise(3, (60, 72))
        regions = RegionMap.from_labels(halves((60, 72)).labels, softness)
        left = residual - render(propose(residual, regions, count, sigmas=SIGMAS), regions)
        assert left.square().sum() < residual.square().sum() * (1 - 0.004 * count)

    def test_more_gaussians_leave_less_error(self) -> None:
        residual = noise(3, (60, 72))
        left = [
            float((residual - render(propose(residual, None, n, sigmas=SIGMAS), None)).square().sum())
            for n in (5, 20, 80, 320)
        ]
        assert left == sorted(left, reverse=True)

    def test_chosen_at_once_lie_apart(self) -> None:
        residual = noise(1, (96, 96), smooth=5)
        means, cholesky, _ = tensors(propose(residual, None, 12, sigmas=SIGMAS))
        for a, b in combinations(range(12), 2):
            square = float(cholesky[a, 0] ** 2 + cholesky[b, 0] ** 2)
            distance = float((means[a] - means[b]).square().sum())
            overlap = 2 * float(cholesky[a, 0] * cholesky[b, 0]) / square * np.exp(-0.5 * distance / square)
            # 0.2 between the middles of blocks, which are then moved to middles of pixels
            assert overlap < 0.3

    def test_same_call_same_bits(self) -> None:
        residual = noise(3, (60, 72))
        first, second = (propose(residual, halves((60, 72)), 40, sigmas=SIGMAS) for _ in range(2))
        assert all(torch.equal(a, b) for a, b in zip(tensors(first), tensors(second), strict=True))

    def test_no_graph_and_no_gradient_needed(self) -> None:
        residual = noise(1, (20, 20)).requires_grad_()
        with torch.no_grad():
            proposal = propose(residual, None, 4, sigmas=SIGMAS)
        assert all(p.is_leaf for p in proposal.parameters())


class TestRegions:
    @pytest.mark.parametrize("size", [(40, 52), (33, 17), (5, 7), (1, 9)])
    def test_centres_are_pixels_of_their_region(self, size: tuple[int, int]) -> None:
        labels = torch.randint(0, 4, size, generator=torch.Generator().manual_seed(1)) * 3
        regions = RegionMap.from_labels(labels)
        means, _, _, ids = tensors(propose(noise(3, size, smooth=1), regions, 30, sigmas=SIGMAS))
        assert len(means) > 0
        assert torch.equal(means - means.floor(), torch.full_like(means, 0.5))
        assert torch.equal(lookup_regions(means, labels), ids)

    def test_error_of_one_region_asks_for_nothing_in_another(self) -> None:
        regions = halves((40, 52))
        residual = noise(3, (40, 52)) * (regions.labels == 9)
        proposal = propose(residual, regions, 30, sigmas=SIGMAS)
        assert proposal.region_ids is not None and set(proposal.region_ids.tolist()) == {9}

    def test_one_pixel_region(self) -> None:
        labels = torch.zeros(20, 20, dtype=torch.long)
        labels[7, 11] = 5
        residual = torch.zeros(2, 20, 20)
        residual[:, 7, 11] = torch.tensor([0.5, -0.25])
        means, _, colors, ids = tensors(propose(residual, RegionMap.from_labels(labels), 3, sigmas=SIGMAS))
        assert means.tolist() == [[11.5, 7.5]] and ids.tolist() == [5]
        torch.testing.assert_close(colors, torch.tensor([[0.5, -0.25]]))

    def test_checkerboard(self) -> None:
        labels = (torch.arange(24)[:, None] + torch.arange(30)) % 2
        regions = RegionMap.from_labels(labels)
        # a flat error in the white squares alone: one wide Gaussian sees it although its neighbours have none
        residual = (0.5 * labels)[None].float()
        proposal = propose(residual, regions, 6, sigmas=SIGMAS)
        assert proposal.region_ids is not None and set(proposal.region_ids.tolist()) == {1}
        left = residual - render(proposal, regions)
        assert left.square().sum() < 0.5 * residual.square().sum()


class TestLimits:
    @pytest.mark.parametrize("regions", [None, halves((20, 30))])
    def test_no_error_nothing_proposed(self, regions: RegionMap | None) -> None:
        proposal = propose(torch.zeros(3, 20, 30), regions, 10, sigmas=SIGMAS)
        assert {len(t) for t in tensors(proposal)} == {0}

    def test_none(self) -> None:
        assert len(propose(noise(1, (8, 8)), None, 0, sigmas=SIGMAS).means) == 0

    def test_more_than_one_round_finds(self) -> None:
        assert len(propose(noise(3, (12, 12), smooth=1), None, 120, sigmas=SIGMAS).means) == 120

    def test_flat_error_is_filled_evenly(self) -> None:
        residual = torch.full((1, 64, 64), 0.3)
        left = residual - render(propose(residual, None, 40, sigmas=SIGMAS), None)
        assert left.square().sum() < 0.15 * residual.square().sum()
