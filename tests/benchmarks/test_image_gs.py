"""Image-GS on the hooks of a fit."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.core.fits import METHODS, method_of, timed_fit
from benchmarks.core.image_gs import OBJECTS, SETTINGS, ImageGSAdam, gradient_field, l1_and_ssim
from kcgs import GaussianField, RegionMap, fit


def photo(channels: int = 3) -> Tensor:
    """Detail on the left, little on the right."""
    y, x = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    phases = torch.arange(channels)[:, None, None]
    return 0.5 + 0.2 * torch.sin(x * 0.9 + phases) * (x < 32) + 0.1 * (y > 30)


def fit_image_gs(image: Tensor, **settings: Any) -> Any:
    arguments = {name: OBJECTS.get(value, value) for name, value in SETTINGS.items()}
    return fit(image, None, 40, **{**arguments, "iterations": 100, **settings})


class TestStart:
    @pytest.mark.parametrize("count", [200, 48 * 64])
    def test_centres_follow_the_detail_and_no_pixel_has_two(self, count: int) -> None:
        labels = (torch.arange(64) > 40).long().expand(48, 64)
        field = gradient_field(photo(2)[None].double(), count, RegionMap(labels), 0)[0]
        assert len(field.means.floor().unique(dim=0)) == field.num_gaussians == count
        assert field.colors.shape == (count, 2) and field.colors.dtype == torch.float64
        assert torch.equal(field.region_ids, (field.means[:, 0] > 41).long())
        if count == 200:
            assert float((field.means[:, 0] < 32).float().mean()) > 0.7

    def test_a_flat_image_is_covered_evenly(self) -> None:
        field = gradient_field(torch.full((1, 1, 60, 60), 0.4), 200, None, 0)[0]
        assert float((field.means[:, 0] < 30).float().mean()) == pytest.approx(0.5, abs=0.1)


def test_parameters_are_the_gaussians() -> None:
    field = GaussianField.random(9, (20, 30), seed=0)
    with torch.no_grad():
        field.cholesky[:, 1] = torch.linspace(-2, 2, 9)
    expected = [tensor.detach().clone() for tensor in (field.means, field.cholesky, field.colors)]
    torch.testing.assert_close(list(ImageGSAdam(field).decode()), expected)
    torch.testing.assert_close([field.means.detach(), field.cholesky.detach(), field.colors.detach()], expected)


def test_a_fit_starts_with_half_and_adds_four_times() -> None:
    result = fit_image_gs(photo(), objective=l1_and_ssim(photo()))
    assert sorted({entry.num_gaussians for entry in result.history}) == [20, 25, 30, 35, 40]
    assert result.scene.num_gaussians == 40 and result.history[-1].loss < 0.5 * result.history[0].loss


def test_the_method_of_the_reports() -> None:
    labels = torch.zeros(48, 64, dtype=torch.int64)
    result, _ = timed_fit(photo(), labels, 40, method_of("image-gs, L1 alone", 100))
    expected = fit_image_gs(photo(), objective="l1")
    assert torch.equal(result.scene.field.means, expected.scene.field.means)
    assert METHODS["image-gs, L1 alone"][1]["iterations"] == 10_000
