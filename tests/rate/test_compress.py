"""Rounding with an eye on the image, and fits to a budget of bytes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import FitConfig, GaussianField, RegionMap, fit
from kcgs.codec import decode, encode
from kcgs.nn.renderer import render_image
from kcgs.rate import compress, fit_bytes
from kcgs.rate.compress import count_for

Fitted = tuple[Tensor, GaussianField, RegionMap]
SHORT = FitConfig.from_recipe("best", iterations=150)


def psnr(field: GaussianField, regions: RegionMap | None, image: Tensor) -> float:
    return -10 * math.log10(float((render_image(field, regions) - image).square().mean()))


@pytest.fixture(scope="module")
def photo(astronaut: Tensor) -> tuple[Tensor, Tensor]:
    """A crop with two regions that its contour separates: face and background."""
    image = torch.nn.functional.avg_pool2d(astronaut[None, :, :240, 100:420], 2)[0]
    row, column = torch.meshgrid(torch.arange(120), torch.arange(160), indexing="ij")
    return image, (((column - 62) / 30.0) ** 2 + ((row - 55) / 45.0) ** 2 < 1).long()


@pytest.fixture(scope="module")
def fitted(photo: tuple[Tensor, Tensor]) -> Fitted:
    image, labels = photo
    result = fit(image, labels, 300, config=SHORT.model_copy(update={"merge_regions": False}))
    assert result.regions is not None
    return image, result.field, result.regions


class TestCompress:
    def test_less_error_at_the_same_bytes(self, fitted: Fitted) -> None:
        image, field, regions = fitted
        target = 1300
        found = {}
        for name, data in (
            ("plain", encode(field, regions, target_bytes=target)),
            ("tuned", compress(field, image, regions, target_bytes=target)),
        ):
            assert 0.97 * target < len(data) <= target
            decoded = decode(data)
            found[name] = psnr(decoded.field, decoded.regions, image)
        assert found["plain"] + 0.1 < found["tuned"]

    def test_quality(self, fitted: Fitted) -> None:
        image, field, regions = fitted
        before = psnr(field, regions, image)
        decoded = decode(compress(field, image, regions, quality=before + 14.5))
        assert before - 0.15 < psnr(decoded.field, decoded.regions, image)

    def test_same_bytes_each_time(self, fitted: Fitted) -> None:
        image, field, regions = fitted
        first, second = (compress(field, image, regions, quality=40, iterations=20) for _ in range(2))
        assert first == second

    def test_faint_ones_do_not_pay(self, fitted: Fitted) -> None:
        image, field, regions = fitted
        colors = field.merged_colors().detach().clone()
        colors[::3] *= 1e-4
        with_faint = GaussianField(field.means, field.cholesky, colors, field.region_ids, size=field.size)
        decoded = decode(compress(with_faint, image, regions, quality=36, iterations=2))
        assert len(decoded.field) <= 200

    @pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
    def test_where_gradients_are_off(self, fitted: Fitted, mode: Callable[[], Any]) -> None:
        image, field, regions = fitted
        expected = compress(field, image, regions, quality=30, iterations=3)
        with mode():
            same = GaussianField(field.means, field.cholesky, field.colors, field.region_ids, size=field.size)
            assert compress(same, image.clone(), RegionMap.from_labels(regions.labels), quality=30, iterations=3)
            assert compress(field, image, regions, quality=30, iterations=3) == expected

    def test_refusals(self, fitted: Fitted) -> None:
        image, field, regions = fitted
        for changed, match in (
            ({"image": image[:, :50]}, "image must have shape"),
            ({"iterations": 0}, "iterations must be at least 1; got 0"),
            ({"quality": 40, "target_bytes": 900}, "exclude each other"),
            ({"target_bytes": 40}, "target_bytes must be at least [0-9]+ for this scene; got 40"),
        ):
            arguments = {"field": field, "image": image, "regions": regions, **changed}
            with pytest.raises(ValueError, match=match):
                compress(**arguments)


class TestBudget:
    @pytest.mark.parametrize("target", [600, 1500])
    def test_file_fits(self, photo: tuple[Tensor, Tensor], target: int) -> None:
        image, labels = photo
        done = fit_bytes(image, labels, target, config=SHORT)
        assert 0.93 * target < len(done.data) <= target
        decoded = decode(done.data)
        assert torch.equal(decoded.field.means, done.field.means)
        assert psnr(done.field, done.regions, image) > 18

    def test_more_bytes_are_better(self, photo: tuple[Tensor, Tensor]) -> None:
        image, labels = photo
        psnrs = []
        for target in (500, 1200, 2600):
            done = fit_bytes(image, labels, target, config=SHORT)
            psnrs.append(psnr(done.field, done.regions, image))
        assert psnrs[0] + 0.8 < psnrs[1] < psnrs[2] - 0.8

    def test_a_map_that_does_not_pay_is_left_out(self, photo: tuple[Tensor, Tensor]) -> None:
        image, _ = photo
        noise = torch.randint(0, 2, (30, 40), generator=torch.Generator().manual_seed(0))
        speckled = noise.repeat_interleave(4, 0).repeat_interleave(4, 1)
        assert fit_bytes(image, speckled, 900, config=SHORT).regions is None

    def test_a_map_that_pays_stays(self) -> None:
        image = torch.full((3, 96, 128), 0.1)
        row, column = torch.meshgrid(torch.arange(96), torch.arange(128), indexing="ij")
        disc = (column - 60) ** 2 + (row - 48) ** 2 < 35**2
        image[:, disc] = 0.9
        done = fit_bytes(image, disc.long(), 250, config=SHORT)
        assert done.regions is not None and psnr(done.field, done.regions, image) > 35

    def test_count_grows_with_bytes(self) -> None:
        counts = [count_for(size) for size in (100, 1000, 8000, 50_000)]
        assert counts == sorted(counts) and 1900 < counts[2] < 2300
        assert count_for(1) == 1

    def test_refusals(self) -> None:
        image = torch.zeros(3, 16, 16)
        with pytest.raises(TypeError, match="target_bytes must be an integer"):
            fit_bytes(image, None, 1.5)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="target_bytes must be at least 1; got 0"):
            fit_bytes(image, torch.arange(16).expand(16, 16), 0)
        with pytest.raises(ValueError, match="target_bytes must be at least"):
            fit_bytes(torch.rand(3, 16, 16), None, 12, config=SHORT)
