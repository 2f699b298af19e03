"""Fits to a file of at most so many bytes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import FitConfig
from kcgs.codec import decode
from kcgs.fitting.problem import Problem, make_problem
from kcgs.functional import edge_band
from kcgs.rate import fit_bytes, region_choice
from kcgs.rate.budget import BUDGETS
from tests.conftest import Clock

from .conftest import Photo, min_sigma, psnr

COLUMN = torch.arange(160).repeat(120, 1)
SPECKLES = torch.randint(0, 2, (30, 40), generator=torch.Generator().manual_seed(0))


def disc(photo: Tensor) -> Photo:
    """Return a bright disc on a dark ground, which a contour explains."""
    row, column = torch.meshgrid(torch.arange(96), torch.arange(128), indexing="ij")
    labels = ((column - 60) ** 2 + (row - 48) ** 2 < 35**2).long()
    return torch.where(labels > 0, 0.9, 0.1).expand(3, -1, -1), labels


def stripes(photo: Tensor) -> Photo:
    """Return a photo with eight regions that have nothing to do with it."""
    return photo, COLUMN // 20


def speckles(photo: Tensor) -> Photo:
    """Return a photo with a label map that takes more bytes than Gaussians in its place."""
    return photo, SPECKLES.repeat_interleave(4, 0).repeat_interleave(4, 1)


@pytest.fixture(autouse=True)
def _short_descent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten what follows the fit, which takes 400 iterations or more."""
    for name, budget in BUDGETS.items():
        monkeypatch.setitem(BUDGETS, name, replace(budget, compress_iterations=80))


class TestFitBytes:
    def test_bytes(self, photo: Photo) -> None:
        """The file fills its bytes, the scene is the file's, and more bytes have less error."""
        image, labels = photo
        psnrs = [10.0]
        for target in (500, 1500):
            file = fit_bytes(image, labels, target, iterations=60, objective="l2")
            assert 0.93 * target < len(file.data) <= target
            assert torch.equal(decode(file.data).scene.field.means, file.scene.field.means)
            assert file.result.stop_reason == "iterations"
            psnrs.append(psnr(file.scene, image))
            assert psnrs[-1] > psnrs[-2] + 0.8

    def test_least_width(self, photo: Photo) -> None:
        """A small file is fitted on a reduced photo, has the photo's size, and no thin Gaussians."""
        file = fit_bytes(photo[0], None, 80, iterations=30)
        least = 0.12 * ((120 * 160 / BUDGETS["ms-ssim"].num_gaussians(80, 120 * 160)) ** 0.5 - 8)
        assert min_sigma(file.scene) > 0.6 * least  # rounded
        assert file.result.config.min_sigma == pytest.approx(least / 2)
        assert file.result.config.objective == "ms-ssim"
        assert file.result.scene.size == file.scene.size == (120, 160)

    def test_clock(self, photo: Photo, clock: Clock) -> None:
        """The clock is that of the fit."""
        file = fit_bytes(*photo, 1500, max_seconds=0.5, iterations=10**7)
        assert file.result.stop_reason == "seconds" and 0.45 < file.result.seconds < 0.6
        assert 0.9 * 1500 < len(file.data) <= 1500

    def test_callback(self, photo: Photo) -> None:
        iterations: list[int] = []

        def stop(iteration: int, _: object) -> bool:
            iterations.append(iteration)
            return iteration == 20

        result = fit_bytes(photo[0], None, 300, iterations=40, on_step=stop).result
        assert result.stop_reason == "callback" and iterations == list(range(1, 21))

    @pytest.mark.parametrize(
        ("problem", "target", "settings", "num_regions", "min_psnr"),
        [
            (disc, 250, {}, 2, 35),
            (speckles, 900, {}, 1, 18),
            (stripes, 900, {"merge_regions": False, "move_contours": False}, 8, 15),
            (stripes, 900, {"guidance": False}, 1, 18),
        ],
    )
    def test_regions(
        self, photo: Photo, problem: Any, target: int, settings: dict[str, Any], num_regions: int, min_psnr: float
    ) -> None:
        """Regions stay that pay for their bytes, or that must not be merged."""
        image, labels = problem(photo[0])
        file = fit_bytes(image, labels, target, iterations=50, **settings)
        regions, report = file.scene.regions, file.result.regions
        assert len(file.data) <= target and psnr(file.scene, image) > min_psnr
        assert (1 if regions is None else regions.num_regions) == num_regions
        assert report is not None and (report.num_before, report.num_after) == (len(labels.unique()), num_regions)
        if "move_contours" in settings:
            assert regions is not None and torch.equal(regions.labels, labels)

    @pytest.mark.parametrize(("error", "is_used"), [(0.1, True), (0.25, False)])
    def test_contours_lower_the_error_along_them(
        self, photo: Photo, monkeypatch: pytest.MonkeyPatch, error: float, is_used: bool
    ) -> None:
        image, labels = disc(photo[0])
        band = edge_band(labels)
        trials = {True: image + 0.2, False: image + error * band}

        def trial(problem: Problem, until: float) -> Any:
            return SimpleNamespace(scene=SimpleNamespace(render=lambda: trials[problem.regions is None]))

        monkeypatch.setattr(region_choice, "fit_problem", trial)
        config = FitConfig(objective="l2")
        choice = region_choice.choose_regions(make_problem(image, labels, None, config, 0), 900)
        assert (choice.regions is not None) == is_used

    @pytest.mark.parametrize(
        ("target", "settings", "error", "match"),
        [
            (1.5, {}, TypeError, "target_bytes must be an integer"),
            (39, {}, ValueError, "target_bytes must be at least 40; got 39"),
            (900, {"target_psnr": 30.0}, ValueError, "target_psnr must be None with target_bytes; got 30"),
        ],
    )
    def test_exceptions(self, target: Any, settings: dict[str, Any], error: type[Exception], match: str) -> None:
        with pytest.raises(error, match=match):
            fit_bytes(torch.rand(3, 16, 16), None, target, **settings)


def test_a_kept_map_that_exceeds_the_file_is_refused_before_the_fit(photo: Photo) -> None:
    with pytest.raises(ValueError, match="target_bytes must be at least [0-9]+ for this map, whose regions are kept"):
        fit_bytes(*speckles(photo[0]), 150, merge_regions=False, iterations=10**9)


def test_gaussian_budget() -> None:
    counts = [BUDGETS["l2"].num_gaussians(size, 10_000) for size in (1, 100, 1000, 8000, 50_000)]
    assert counts == sorted(counts) and counts[0] == 1 and 2200 < counts[3] < 2700
    assert BUDGETS["ms-ssim"].num_gaussians(8000, 10_000) < 0.95 * counts[3]
