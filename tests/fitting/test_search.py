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
    def test_a_tenth_fewer_are_too_few(self, photo: tuple[Tensor, Tensor]) -> None:
        (image, labels), target = photo, 22.0
        result = fit(image, labels, 200, recipe=quick(target_psnr=target))
        assert result.stop_reason == "target_psnr" and measured(result, image) >= target
        fewer = int(0.9 * result.scene.num_gaussians)
        assert measured(fit(image, labels, fewer, recipe=quick()), image) < target

    def test_out_of_reach_is_the_best_with_as_many(self, photo: tuple[Tensor, Tensor]) -> None:
        result = fit(*photo, 30, recipe=quick(target_psnr=60.0))
        plain = fit(*photo, 30, recipe=quick())
        assert result.stop_reason == "iterations"
        assert result.scene.num_gaussians == plain.scene.num_gaussians
        assert measured(result, photo[0]) > measured(plain, photo[0]) - 1.0

    def test_one_is_enough(self) -> None:
        result = fit(torch.full((3, 24, 32), 0.5), None, 100, recipe=quick(target_psnr=20.0))
        assert result.stop_reason == "target_psnr" and result.scene.num_gaussians == 1

    @pytest.mark.parametrize("target", [13.0, 21.0])
    def test_regions_are_merged_for_the_number_of_gaussians(self, photo: tuple[Tensor, Tensor], target: float) -> None:
        """Not for that of a trial before: with fewer none stays black, with more none is merged."""
        image, (y, x) = photo[0], torch.meshgrid(torch.arange(32), torch.arange(48), indexing="ij")
        labels = y // 8 * 6 + x // 8  # 24 regions
        with warnings.catch_warnings(action="ignore"):  # of merged regions
            result = fit(image, labels, 300, recipe=quick(target_psnr=target, prune=0.0))
        count, regions = result.scene.num_gaussians, result.scene.regions
        assert result.stop_reason == "target_psnr" and result.regions is not None and result.regions.empty == 0
        assert (1 if regions is None else regions.num_regions) >= min(count, 24) - 2


class TestStopping:
    @pytest.mark.usefixtures("clock")
    def test_clock(self, photo: tuple[Tensor, Tensor]) -> None:
        result = fit(*photo, 500, recipe=FitConfig(iterations=10**6, max_seconds=0.5, target_psnr=150.0))
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
