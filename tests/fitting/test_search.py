"""The fewest Gaussians for a PSNR."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import fit
from kcgs.fitting import FitConfig
from kcgs.functional import psnr
from kcgs.rate import compress, fit_bytes


def quick(**settings: Any) -> FitConfig:
    return FitConfig(iterations=40, **settings)


@pytest.fixture(scope="module")
def photo() -> tuple[Tensor, Tensor]:
    """Return an image whose PSNR rises slowly with the number of Gaussians, and its two regions."""
    generator = torch.Generator().manual_seed(5)
    coarse = torch.rand(1, 3, 6, 9, generator=generator)
    fine = torch.rand(1, 3, 16, 24, generator=generator)
    grow = torch.nn.functional.interpolate
    image = 0.7 * grow(coarse, (32, 48), mode="bicubic") + 0.3 * grow(fine, (32, 48), mode="bicubic")
    labels = torch.zeros(32, 48, dtype=torch.long)
    labels[8:26, 16:38] = 1
    return (image[0] * (1 - 0.4 * labels)).clamp(0, 1), labels


def measured(result: Any, image: Tensor) -> float:
    return float(psnr(result.scene.render(), image))


class TestFewest:
    def test_as_few_as_bisection_finds(self, photo: tuple[Tensor, Tensor]) -> None:
        (image, labels), target = photo, 22.0
        result = fit(image, labels, 200, recipe=quick(target_psnr=target))
        assert result.stop_reason == "target_psnr"
        assert measured(result, image) >= target
        low, high = 1, 200  # enough Gaussians
        while high / low > 1.05 and high - low > 1:
            middle = min(max(round((low * high) ** 0.5), low + 1), high - 1)
            enough = measured(fit(image, labels, middle, recipe=quick()), image) >= target
            low, high = (low, middle) if enough else (middle, high)
        assert result.scene.num_gaussians <= max(1.05 * high, high + 1)

    def test_out_of_reach_is_the_best_with_as_many(self, photo: tuple[Tensor, Tensor]) -> None:
        result = fit(*photo, 30, recipe=quick(target_psnr=60.0))
        plain = fit(*photo, 30, recipe=quick())
        assert result.stop_reason == "iterations"
        assert result.scene.num_gaussians == plain.scene.num_gaussians
        assert measured(result, photo[0]) > measured(plain, photo[0]) - 1.0

    def test_one_is_enough(self) -> None:
        result = fit(torch.full((3, 24, 32), 0.5), None, 100, recipe=quick(target_psnr=20.0))
        assert result.stop_reason == "target_psnr" and result.scene.num_gaussians == 1

    def test_same_result_again(self, photo: tuple[Tensor, Tensor]) -> None:
        first, second = (fit(*photo, 200, recipe=quick(target_psnr=20.0)) for _ in range(2))
        assert torch.equal(first.scene.render(), second.scene.render())

    def test_regions_are_merged_for_the_number_of_gaussians(self, photo: tuple[Tensor, Tensor]) -> None:
        """Not for that of a trial before: with fewer none stays black, with more none is merged."""
        image, (y, x) = photo[0], torch.meshgrid(torch.arange(32), torch.arange(48), indexing="ij")
        labels = y // 8 * 6 + x // 8  # 24 regions
        for target in (13.0, 21.0):
            with warnings.catch_warnings(action="ignore"):  # of merged regions
                result = fit(image, labels, 300, recipe=quick(target_psnr=target, prune=0.0))
            count, regions = result.scene.num_gaussians, result.scene.regions
            assert result.stop_reason == "target_psnr" and result.regions is not None and result.regions.empty == 0
            assert (1 if regions is None else regions.num_regions) >= min(count, 24) - 2

    def test_published_recipes_too(self, photo: tuple[Tensor, Tensor]) -> None:
        result = fit(*photo, 400, recipe="gaussian-image", iterations=40, target_psnr=14.0)
        assert result.stop_reason == "target_psnr" and measured(result, photo[0]) >= 14.0


class TestStopping:
    def test_no_target(self, photo: tuple[Tensor, Tensor]) -> None:
        result = fit(*photo, 10, recipe=quick())
        assert result.seconds >= result.history[-1].seconds

    @pytest.mark.usefixtures("clock")
    def test_clock(self, photo: tuple[Tensor, Tensor]) -> None:
        result = fit(*photo, 500, recipe=FitConfig(iterations=10**6, max_seconds=1.0, target_psnr=150.0))
        assert result.stop_reason == "seconds"

    def test_callback_counts_the_iterations_of_each_fit(self, photo: tuple[Tensor, Tensor]) -> None:
        seen: list[int] = []

        def on_step(iteration: int, entry: Any) -> bool:
            seen.append(iteration)
            return len(seen) == 50

        result = fit(*photo, 700, recipe=quick(target_psnr=26.0), on_step=on_step)
        assert seen[:40] == list(range(1, 41)) and len(seen) == 50
        assert result.stop_reason == "callback"


def test_a_checkpoint_is_refused(photo: tuple[Tensor, Tensor]) -> None:
    with pytest.raises(ValueError, match="checkpoint must be None with target_psnr"):
        fit(*photo, 10, target_psnr=20.0, checkpoint="state")


def test_bytes_and_psnr_exclude_each_other(photo: tuple[Tensor, Tensor]) -> None:
    with pytest.raises(ValueError, match="target_psnr must be None"):
        fit_bytes(*photo, 500, target_psnr=20.0)


def test_a_file_that_shows_it(photo: tuple[Tensor, Tensor]) -> None:
    image, labels = photo
    scene = fit(image, labels, 60, recipe=quick()).scene
    own = float(psnr(scene.render(), image))
    tight, loose = (compress(scene, image, target_psnr=own - less, iterations=5) for less in (0.01, 3.0))
    assert float(psnr(tight.scene.render(), image)) >= own - 0.01
    assert len(loose.data) <= len(tight.data)
    with pytest.raises(ValueError, match="target_psnr must be None with quality or target_bytes"):
        compress(scene, image, target_psnr=20.0, quality=40.0)
