"""Fits to a budget of bytes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs.codec import decode
from kcgs.functional import ms_ssim
from kcgs.rate import fit_bytes
from kcgs.rate.budget import count_for
from tests.conftest import Clock

from .conftest import Photo, psnr


class TestFitBytes:
    @pytest.mark.parametrize("target", [600, 1500])
    def test_file_fits(self, photo: Photo, target: int) -> None:
        image, labels = photo
        done = fit_bytes(image, labels, target, iterations=150)
        assert 0.93 * target < len(done.data) <= target
        assert torch.equal(decode(done.data).scene.field.means, done.scene.field.means)
        assert psnr(done.scene, image) > 18

    def test_the_clock_is_that_of_the_fit(self, photo: Photo, clock: Clock) -> None:
        done = fit_bytes(*photo, 1500, max_seconds=1.0, iterations=10**7)
        assert done.result.stop_reason == "seconds" and 0.9 < done.result.seconds < 1.15
        assert 0.9 * 1500 < len(done.data) <= 1500

    def test_a_fit_ends_early_and_says_what_ended_it(self, photo: Photo) -> None:
        assert fit_bytes(photo[0], None, 600, iterations=100).result.stop_reason == "iterations"
        seen: list[int] = []
        done = fit_bytes(photo[0], None, 600, iterations=100, on_step=lambda i, _: seen.append(i) or i == 60)
        assert done.result.stop_reason == "callback" and seen[-1] == 60

    def test_more_bytes_are_better(self, photo: Photo) -> None:
        image, labels = photo
        psnrs = []
        for target in (500, 1200, 2600):
            done = fit_bytes(image, labels, target, iterations=150)
            psnrs.append(psnr(done.scene, image))
        assert psnrs[0] + 0.8 < psnrs[1] < psnrs[2] - 0.8

    def test_a_map_that_does_not_pay_is_left_out(self, photo: Photo) -> None:
        image, _ = photo
        noise = torch.randint(0, 2, (30, 40), generator=torch.Generator().manual_seed(0))
        speckled = noise.repeat_interleave(4, 0).repeat_interleave(4, 1)
        done = fit_bytes(image, speckled, 900, iterations=150)
        report = done.result.regions
        assert done.scene.regions is None and report is not None
        assert (report.given, report.kept) == (2, 1) and (report.dropped == "bytes" or report.merged_for_bytes == 1)

    def test_a_map_that_is_to_stay_stays(self, photo: Photo) -> None:
        labels = (torch.arange(160) // 20).repeat(120, 1)
        done = fit_bytes(photo[0], labels, 900, iterations=100, merge_regions=False, move_contours=False)
        assert len(done.data) <= 900
        assert torch.equal(decode(done.data).scene.regions.labels, labels)

    def test_a_map_that_pays_stays(self) -> None:
        image = torch.full((3, 96, 128), 0.1)
        row, column = torch.meshgrid(torch.arange(96), torch.arange(128), indexing="ij")
        disc = (column - 60) ** 2 + (row - 48) ** 2 < 35**2
        image[:, disc] = 0.9
        done = fit_bytes(image, disc.long(), 250, iterations=150)
        assert done.scene.regions is not None and psnr(done.scene, image) > 35
        assert done.result.regions is not None and done.result.regions.kept == done.result.regions.given == 2

    def test_ms_ssim(self, astronaut: Tensor) -> None:
        image = astronaut[:, 20:196, 130:306]
        shown = {
            name: fit_bytes(image, None, 900, iterations=150, objective=name).scene.render()
            for name in ("psnr", "ms-ssim")
        }
        assert ms_ssim(shown["psnr"], image) + 0.005 < ms_ssim(shown["ms-ssim"], image)

    def test_count_grows_with_bytes(self) -> None:
        assert count_for(8000, 10_000, "ms-ssim") < 0.95 * count_for(8000, 10_000)
        counts = [count_for(size, 10_000) for size in (100, 1000, 8000, 50_000)]
        assert counts == sorted(counts) and 2200 < counts[2] < 2700
        assert count_for(1, 10_000) == 1

    def test_refusals(self) -> None:
        image = torch.zeros(3, 16, 16)
        with pytest.raises(TypeError, match="num_bytes must be an integer"):
            fit_bytes(image, None, 1.5)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="num_bytes must be at least 1; got 0"):
            fit_bytes(image, torch.arange(16).expand(16, 16), 0)
        with pytest.raises(ValueError, match="target_bytes must be at least"):
            fit_bytes(torch.rand(3, 16, 16), None, 12, iterations=150)
