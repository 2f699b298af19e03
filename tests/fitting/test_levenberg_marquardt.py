"""Colours by least squares, the last steps of small scenes, and which scenes these are."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, Scene
from kcgs.data import chart_2x3, chart_pie
from kcgs.fitting.colors import solve_colors
from kcgs.fitting.frame import move
from kcgs.fitting.levenberg_marquardt import _bounded, _measure, _patches, is_flat, levenberg_marquardt
from kcgs.functional import psnr, region_splat

SIZE = (18, 26)


def a_map(softness: float = 0.0) -> RegionMap:
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    return RegionMap.from_labels(torch.where((x - 16) ** 2 + (y - 9) ** 2 < 36, 7, (x > 10) * 2), softness)


def a_field(regions: RegionMap | None, channels: int = 3, count: int = 8, seed: int = 0) -> GaussianField:
    field = GaussianField.random(
        count, SIZE, channels=channels, sigma=5.0, regions=regions, seed=seed, dtype=torch.float64
    )
    with torch.no_grad():
        field.cholesky[:, 1] = torch.linspace(-2, 2, count)
    return field


def an_image(channels: int = 3) -> Tensor:
    return torch.rand(channels, *SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def rendered(field: GaussianField, regions: RegionMap | None, cutoff: float = 0.0) -> Tensor:
    ids = None if regions is None else field.region_ids
    colors = field.merged_colors()
    return region_splat(field.means, field.cholesky, colors, ids, regions, size=field.size, cutoff=cutoff).detach()


def error(field: GaussianField, regions: RegionMap | None, image: Tensor, cutoff: float = 0.0) -> float:
    return float((rendered(field, regions, cutoff).double() - image).square().sum())


def solved_colors(field: Any, image: Tensor, regions: RegionMap | None, **settings: Any) -> GaussianField:
    return solve_colors(Scene(field, regions), image, **settings).field


def refined_all(field: Any, image: Tensor, regions: RegionMap | None, **settings: Any) -> GaussianField:
    return levenberg_marquardt(Scene(field, regions), image, max_seconds=1e9, **settings).field


MAPS = pytest.mark.parametrize("regions", [None, a_map(), a_map(0.8)], ids=["none", "hard", "soft"])


class TestSolveColors:
    @MAPS
    @pytest.mark.parametrize("channels", [1, 4])
    def test_equal_dense_least_squares(self, regions: RegionMap | None, channels: int) -> None:
        field, image = a_field(regions, channels), an_image(channels)
        units = [
            region_splat(
                field.means[i : i + 1],
                field.cholesky[i : i + 1],
                torch.ones(1, 1, dtype=torch.float64),
                None if regions is None or field.region_ids is None else field.region_ids[i : i + 1],
                regions,
                size=SIZE,
                cutoff=0.0,
            ).detach()
            for i in range(field.num_gaussians)
        ]
        matrix = torch.stack(units).flatten(1).T
        best = torch.linalg.lstsq(matrix, image.flatten(1).T).solution
        solved = solved_colors(field, image, regions, steps=60, cutoff=0.0, damping=0.0)
        torch.testing.assert_close(solved.colors.detach(), best, rtol=1e-6, atol=1e-7)
        assert torch.equal(solved.means, field.means) and torch.equal(solved.cholesky, field.cholesky)

    @pytest.mark.parametrize("steps", [1, 2, 5, 20])
    def test_any_number_of_steps_lowers_the_error(self, steps: int) -> None:
        regions, image = a_map(0.7), an_image().float()
        field = a_field(regions).float()
        assert error(solved_colors(field, image, regions, steps=steps), regions, image, 1e-4) < error(
            field, regions, image, 1e-4
        )

    def test_near_duplicates_stay_small(self) -> None:
        field, image = a_field(None).float(), an_image().float()
        with torch.no_grad():
            field.means[1] = field.means[0] + 1e-3
            field.cholesky[1] = field.cholesky[0]
        assert float(solved_colors(field, image, None, steps=200).colors.detach().abs().max()) < 3

    def test_nothing_to_gain_gives_the_start(self) -> None:
        field = a_field(None)
        assert solved_colors(field, rendered(field, None, 1e-4), None) is field

    @pytest.mark.filterwarnings("ignore:1 of 8 Gaussians paint nothing:UserWarning")
    def test_unseen_gaussians_and_opacities(self) -> None:
        regions = a_map()
        start = a_field(regions)
        ids = start.region_ids
        assert ids is not None
        ids[0] = 99
        with torch.no_grad():
            start.means[1] = 5000.0
        opacities = torch.linspace(0.1, 1, start.num_gaussians, dtype=torch.float64)
        field = GaussianField(start.means, start.cholesky, start.colors, ids, opacities, size=SIZE)
        for solved in (solved_colors(field, an_image(), regions), refined_all(field, an_image(), regions, max_steps=5)):
            assert solved is not field and solved.opacities is None
            assert torch.equal(solved.colors[0], field.merged_colors()[0])


class TestLevenbergMarquardt:
    @MAPS
    def test_derivatives_are_those_of_autograd(self, regions: RegionMap | None) -> None:
        field, image = a_field(regions, 2), an_image(2)
        start = [t.detach() for t in (field.means, field.cholesky, field.colors)]
        state = _measure(_patches(field, image, regions), *start, 0.0)
        count = field.num_gaussians

        def render(step: Tensor, colors: Tensor) -> Tensor:
            means, cholesky = move(state.means, state.cholesky, step.view(5, count).T, exact=False)
            ids = None if regions is None else field.region_ids
            return region_splat(means, cholesky, colors, ids, regions, size=SIZE, cutoff=0.0, backend="reference")

        zero = torch.zeros(5 * count, dtype=torch.float64)
        jacobian, by_color = torch.autograd.functional.jacobian(render, (zero, state.colors))
        jacobian = jacobian.flatten(0, 2)  # [C H W, 5 N]
        residual = (image - render(zero, state.colors)).flatten()
        alike = (state.colors @ state.colors.T).repeat(5, 5)
        gram = state.gram[1:, :, 1:].reshape(5 * count, -1) * alike
        torch.testing.assert_close(gram, jacobian.T @ jacobian, rtol=1e-9, atol=1e-9)
        slope = (state.moments[1:] * state.colors).sum(-1).flatten()
        torch.testing.assert_close(slope, jacobian.T @ residual, rtol=1e-7, atol=1e-7)
        assert float(slope.abs().max()) > 1e-3
        torch.testing.assert_close(state.cost, float(residual.square().sum()), rtol=1e-5, atol=0.0)
        # the colours are at their best, but for what they are charged
        assert float((by_color.flatten(0, 2).flatten(1).T @ residual).abs().max()) < 1e-4

    @MAPS
    @pytest.mark.parametrize("channels", [1, 4])
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_better_than_colors_alone(self, regions: RegionMap | None, channels: int, dtype: torch.dtype) -> None:
        field, image = a_field(regions, channels).to(dtype), an_image(channels).to(dtype)
        refined = refined_all(field, image, regions, max_steps=10)
        solved = solved_colors(field, image, regions, steps=60, cutoff=0.0)
        assert refined.means.dtype == dtype
        assert error(refined, regions, image) < 0.99 * error(solved, regions, image)

    def test_finds_a_scene_again(self) -> None:
        regions = a_map(0.8)
        truth = a_field(regions, count=5)
        start = a_field(regions, count=5)
        with torch.no_grad():
            start.means += 0.3
            start.cholesky[:, ::2] *= 1.1
        image = rendered(truth, regions).clamp(0, 1)
        assert torch.equal(image, rendered(truth, regions))
        refined = refined_all(start, image, regions)
        assert float(psnr(rendered(refined, regions), image)) > 90

    def test_never_worse(self) -> None:
        field = a_field(None)
        assert refined_all(field, rendered(field, None), None) is field

    @MAPS
    def test_bounds(self, regions: RegionMap | None, monkeypatch: pytest.MonkeyPatch) -> None:
        field, image = a_field(regions), an_image()
        limits = (1.5, 6.0)
        module = sys.modules[levenberg_marquardt.__module__]
        monkeypatch.setattr(module, "_SIGMA_LIMITS", (limits[0], limits[1] / math.hypot(*SIZE)))
        refined = refined_all(field, image, regions, max_steps=30)
        assert refined is not field
        means, cholesky = refined.means.detach(), refined.cholesky.detach()
        assert limits[0] <= float(cholesky[:, ::2].min()) and float(cholesky.abs().max()) <= limits[1] + 1e-9
        reach = 3 * math.hypot(*SIZE)
        assert -reach <= float(means.min()) and float(means.max()) <= reach + max(SIZE)

    def test_bounds_keep_the_slope(self, monkeypatch: pytest.MonkeyPatch) -> None:
        module = sys.modules[levenberg_marquardt.__module__]
        monkeypatch.setattr(module, "_SIGMA_LIMITS", (0.5, 10.0 / math.hypot(*SIZE)))
        far, wide = torch.tensor([[1e4, -1e4]]).double(), torch.tensor([[20.0, -40.0, 0.1]]).double()
        means, cholesky = _bounded(far, wide, SIZE)
        assert cholesky.tolist() == [[5.0, -10.0, 0.5]]
        diagonal = math.hypot(*SIZE)
        torch.testing.assert_close(means, torch.tensor([[SIZE[1] + 3 * diagonal, -3 * diagonal]]).double())

    def test_constant_region_in_float32(self) -> None:
        image = torch.full((3, 60, 90), 0.3)
        field = GaussianField.random(1, (60, 90), sigma=20.0, seed=0)
        assert float(psnr(rendered(refined_all(field, image, None), None), image)) > 105

    def test_same_bits(self) -> None:
        regions, image = a_map(0.8), an_image().float()
        field = a_field(regions).float()
        first, second = (refined_all(field, image, regions, max_steps=5) for _ in range(2))
        for name in ("means", "cholesky", "colors"):
            assert torch.equal(getattr(first, name), getattr(second, name))

    def test_pixels_in_several_chunks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        regions, image = a_map(0.8), an_image()
        field = a_field(regions)
        start = [t.detach() for t in (field.means, field.cholesky, field.colors)]
        whole = _measure(_patches(field, image, regions), *start, 0.0)
        monkeypatch.setattr(sys.modules[levenberg_marquardt.__module__], "_CHUNK_ELEMENTS", 100)
        parts = _measure(_patches(field, image, regions), *start, 0.0)
        torch.testing.assert_close(parts.gram, whole.gram)
        torch.testing.assert_close(parts.cost, whole.cost)


class TestCharts:
    def test_blocks(self) -> None:
        image, labels = chart_2x3()
        regions = RegionMap.from_labels(labels)
        field = GaussianField.random(20, (200, 300), sigma=30.0, seed=0)
        with torch.no_grad():
            field.means[:6] = torch.tensor([[x, y] for y in (50.0, 150.0) for x in (50.0, 150.0, 250.0)])
        refined = refined_all(field.assign_regions(regions), image, regions)
        assert float(psnr(rendered(refined, regions), image)) > 105

    def test_pie_with_exact_coverage(self) -> None:
        image, labels = chart_pie()
        field = GaussianField.random(20, (300, 300), sigma=30.0, seed=3)
        regions = RegionMap.from_labels(chart_pie(scale=8).labels, supersample=8)
        angle = torch.arange(8) * math.pi / 4
        with torch.no_grad():
            field.means[0] = 2.0
            field.means[1:9] = 150 + 90 * torch.stack([angle.sin(), -angle.cos()], -1)
        refined = refined_all(field.assign_regions(regions), image, regions, max_steps=3)
        assert refined.region_ids is not None and len(refined.region_ids.unique()) == 9
        assert float(psnr(rendered(refined, regions), image)) > 90

    @pytest.mark.parametrize("chart", [chart_2x3, chart_pie])
    def test_are_flat(self, chart: object) -> None:
        image, labels = chart()  # type: ignore[operator]
        regions = RegionMap.from_labels(labels)
        assert is_flat(image, regions, 20) and is_flat(image, RegionMap.from_labels(labels, 0.7), 64)
        assert not is_flat(image, regions, 65)
        assert not is_flat(image, regions, regions.num_regions - 1)
        assert not is_flat(image, None, 20)


class TestIsFlat:
    def test_ramps_are_and_texture_is_not(self) -> None:
        x = torch.linspace(0, 1, 80).expand(3, 60, 80)
        labels = (x[0] > 0.5).long()
        image = torch.where(labels.bool(), 0.3 + 0.5 * x**2, 0.9 - x)
        assert is_flat(image, RegionMap.from_labels(labels), 20)
        noise = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0))
        assert not is_flat(image + 0.05 * noise, RegionMap.from_labels(labels), 20)

    def test_nothing_but_contours(self) -> None:
        labels = torch.arange(12).expand(10, 12) // 2
        assert not is_flat(torch.zeros(1, 10, 12), RegionMap.from_labels(labels), 20)

    def test_photographs_are_not(self, astronaut: Tensor) -> None:
        half = (torch.arange(512).expand(512, 512) > 200).long()
        assert not is_flat(astronaut, None, 20) and not is_flat(astronaut, RegionMap.from_labels(half), 20)
