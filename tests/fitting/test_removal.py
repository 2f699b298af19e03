"""Which Gaussians are removed, and what the others get."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, fit
from kcgs.fitting import lowest_impact
from kcgs.fitting.removal import lowest_weighted_impact
from kcgs.functional import psnr, region_splat
from kcgs.optim.gaussians import Gaussians, Renderer

SIZE = (40, 60)


class RemovalCase:
    """Gaussians of one size, and their render."""

    def __init__(self, means: list[list[float]], colors: list[float], labels: Tensor | None = None) -> None:
        self.means = torch.tensor(means, dtype=torch.float32)
        self.cholesky = torch.tensor([2.5, 0.5, 2.0]).repeat(len(means), 1)
        self.colors = torch.tensor(colors)[:, None] * torch.tensor([[1.0, 0.5, -0.25]])
        self.regions = None if labels is None else RegionMap(labels)
        self.ids = None if labels is None else labels[self.means[:, 1].long(), self.means[:, 0].long()]

    def render(self, means: Tensor, cholesky: Tensor, colors: Tensor) -> Tensor:
        return region_splat(means, cholesky, colors, self.ids, self.regions, size=SIZE, cutoff=1e-3)

    def remove(self, count: int, weight: Tensor | None = None) -> tuple[list[int], Tensor, float, float]:
        """Return who is removed, the colours of all, and the squared error without and with these colours."""
        weight = torch.ones(len(self.means)) if weight is None else weight
        gaussians = Gaussians(self.means, self.cholesky, self.colors, self.ids)
        removed, colors = lowest_weighted_impact(Renderer(SIZE, self.regions, 1e-3), gaussians, count, weight)
        image = self.render(self.means, self.cholesky, self.colors)
        errors = [
            float((self.render(self.means, self.cholesky, c * ~removed[:, None]) - image).square().sum())
            for c in (self.colors, colors)
        ]
        return removed.nonzero()[:, 0].tolist(), colors, *errors


@pytest.mark.parametrize("count", [1, 2])
def test_a_twin_goes_and_the_other_gets_its_colour(count: int) -> None:
    scene = RemovalCase([[20, 20], [45, 20], [20, 20], [45, 35]], [1.0, 0.7, 0.9, 1.2])
    removed, colors, _, error = scene.remove(count)
    assert removed == [1, 2][-count:]
    torch.testing.assert_close(colors[0], 1.9 * scene.colors[0] / 1.0, atol=0.05, rtol=0.05)
    torch.testing.assert_close(colors[3], scene.colors[3], atol=0.05, rtol=0.05)
    assert count == 2 or error < 1e-3


def test_the_weaker_goes_unless_its_error_counts_more() -> None:
    scene = RemovalCase([[10, 20], [30, 20], [50, 20]], [1.0, 0.5, 0.8])
    assert scene.remove(1)[0] == [1]
    assert scene.remove(2)[0] == [1, 2]
    assert scene.remove(1, torch.tensor([1.0, 9.0, 1.0]))[0] == [2]


def test_other_regions_do_not_help() -> None:
    labels = (torch.arange(60) >= 30).long().expand(SIZE).contiguous()
    scene = RemovalCase([[29.9, 20], [30.1, 20], [10, 20]], [1.0, 1.0, 0.99], labels)
    removed, colors, _, _ = scene.remove(1)
    assert removed == [2] and torch.equal(colors[:2], scene.colors[:2])


def test_colours_of_the_others_lower_the_error() -> None:
    generator = torch.Generator().manual_seed(0)
    means = (torch.rand(120, 2, generator=generator) * torch.tensor([60.0, 40.0])).tolist()
    labels = (torch.arange(60) >= 30).long().expand(SIZE).contiguous()
    scene = RemovalCase(means, torch.randn(120, generator=generator).tolist(), labels)
    scene.regions = RegionMap(labels, 0.8)
    removed, _, without, error = scene.remove(15)
    assert len(removed) == 15 and error < 0.8 * without


@pytest.mark.parametrize("count", [0, 5])
def test_extremes_are_finite(count: int) -> None:
    scene = RemovalCase([[15, 15]] * 5, [1.0] * 5)
    scene.cholesky[0], scene.cholesky[1] = torch.tensor([1e4, 0.0, 0.1]), torch.tensor([1e-3, 0.0, 1e-3])
    removed, colors, _, _ = scene.remove(count)
    assert len(removed) == count and torch.isfinite(colors).all()


@pytest.mark.parametrize("maps", [None, "one", "each"])
def test_a_batch_is_as_each_image_alone(maps: str | None) -> None:
    """Bit for bit on a CPU; rows of colour 0 are the first to go."""
    labels = torch.stack([(torch.arange(60) >= x).long().expand(SIZE) for x in (20, 30, 40)])
    regions = {None: None, "one": labels[0], "each": RegionMap(labels)}[maps]
    own = [None if maps is None else labels[0 if maps == "one" else k] for k in range(3)]
    fields = [GaussianField.random(50, SIZE, regions=one, seed=k, sigma=4.0) for k, one in enumerate(own)]
    fields[1].colors.data[7:12] = 0.0
    mask, colors = lowest_impact(GaussianField.stack(fields), 12, regions)
    for k, (field, one) in enumerate(zip(fields, own, strict=True)):
        expected = lowest_impact(field, 12, one)
        assert torch.equal(mask[k], expected[0]) and torch.equal(colors[k], expected[1])
    assert mask[1, 7:12].all()


class TestFit:
    image = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0))

    @pytest.mark.parametrize("stop", [25, 60])
    def test_no_state_has_more_than_n(self, stop: int) -> None:
        """Wherever a fit is stopped, there are no more Gaussians than asked for, and what is logged is what is kept."""
        result = fit(self.image, None, 50, iterations=60, on_step=lambda iteration, entry: iteration == stop, prune=0.0)
        assert result.scene.num_gaussians <= 50
        assert all(entry.num_gaussians <= 50 for entry in result.history)
        best = max(entry.psnr for entry in result.history if entry.num_gaussians == result.scene.num_gaussians)
        assert float(psnr(result.scene.render(), self.image)) >= best - 0.05

    def test_all_from_the_start_means_no_cycles(self) -> None:
        counts = []
        fit(self.image, None, 50, iterations=40, densify_from=1.0, on_step=lambda i, e: counts.append(e.num_gaussians))
        assert set(counts) == {50}
