"""Metrics of a scene against an image."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.data
import torch
from PIL import Image

from kcgs import GaussianField, RegionMap, Scene, evaluate
from kcgs.data import load_image, save_image
from kcgs.evaluation import ssimulacra2
from kcgs.functional import ef_psnr, psnr, ssim

SIZE = (40, 60)
LABELS = (torch.arange(60) >= 30).long().expand(SIZE)


def make_scene(labels: torch.Tensor | None = LABELS) -> Scene:
    return Scene(GaussianField.random(30, SIZE, regions=labels, seed=0), labels)


@pytest.mark.filterwarnings("ignore:ms_ssim is NaN:RuntimeWarning")
class TestEvaluate:
    def test_small_images_have_no_ms_ssim(self) -> None:
        with pytest.warns(RuntimeWarning, match="ms_ssim is NaN: the image has 40 x 60 pixels, its window needs 161"):
            assert math.isnan(evaluate(make_scene(), make_scene().render())["ms_ssim"])

    def test_metrics_of_the_clipped_render(self) -> None:
        scene, image = make_scene(), torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0))
        metrics = evaluate(scene, image)
        render = scene.render()
        assert metrics["psnr"] == float(psnr(render, image)) and metrics["ssim"] == float(ssim(render, image))
        assert metrics["ef_psnr"] == float(ef_psnr(render, image, LABELS)) and math.isnan(metrics["ms_ssim"])
        assert metrics.keys() >= {"psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim", "ssimulacra2"}

    def test_arrays_and_pil_images_are_images(self) -> None:
        levels = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
        expected = evaluate(make_scene(), torch.from_numpy(levels).permute(2, 0, 1).float() / 255)
        np.testing.assert_equal(evaluate(make_scene(), levels), expected)
        np.testing.assert_equal(evaluate(make_scene(), Image.fromarray(levels)), expected)

    def test_labels_have_the_contours(self) -> None:
        scene, image = make_scene(None), torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0))
        assert math.isnan(evaluate(scene, image)["ef_psnr"])
        soft = RegionMap.from_labels(LABELS, 0.7)
        values = {
            evaluate(scene, image, labels)["ef_psnr"]
            for labels in (soft, LABELS, LABELS.bool(), LABELS.numpy(), LABELS[None])
        }
        assert len(values) == 1 and values.pop() > 0

    @pytest.mark.parametrize(
        ("scene", "image", "labels", "message"),
        [
            (make_scene(), torch.zeros(3, 40, 61), None, r"have the scene's shape \(3, 40, 60\); got \(3, 40, 61\)"),
            (make_scene().field, torch.zeros(3, 40, 60), None, "scene must be a Scene; got GaussianField"),
            (make_scene(), torch.zeros(3, 40, 60), [[0, 1]], "labels must be a RegionMap"),
        ],
    )
    def test_bad_arguments(self, scene: Any, image: Any, labels: Any, message: str) -> None:
        with pytest.raises((TypeError, ValueError), match=message):
            evaluate(scene, image, labels)


@pytest.mark.filterwarnings("ignore:ms_ssim is NaN:RuntimeWarning")
class TestSsimulacra2:
    def test_values(self, tmp_path: Path) -> None:
        package = pytest.importorskip("ssimulacra2", reason="SSIMULACRA2 needs the package ssimulacra2")
        photo = torch.from_numpy(skimage.data.astronaut()[:256, :240].copy()).permute(2, 0, 1).float() / 255
        assert ssimulacra2(photo, photo) == 100
        save_image(tmp_path / "photo.png", photo)
        scores = []
        for quality in (90, 50, 10):
            Image.open(tmp_path / "photo.png").save(tmp_path / f"{quality}.jpg", quality=quality)
            scores.append(ssimulacra2(load_image(tmp_path / f"{quality}.jpg"), photo))
            expected = package.compute_ssimulacra2(tmp_path / "photo.png", tmp_path / f"{quality}.jpg")
            assert scores[-1] == pytest.approx(expected, abs=1e-9)
        assert 100 > scores[0] > 70 > scores[1] > 40 > scores[2]
        grey, dark = photo[:1], photo[:1] * 0.9
        assert ssimulacra2(dark, grey) == ssimulacra2(dark.expand(3, -1, -1), grey.expand(3, -1, -1)) < 100

    def test_not_defined(self) -> None:
        assert all(math.isnan(ssimulacra2(t, t)) for t in (torch.ones(3, 7, 60), torch.ones(4, 40, 60)))

    def test_left_out(self) -> None:
        metrics = evaluate(make_scene(), make_scene().render(), with_ssimulacra2=False)
        assert "ssimulacra2" not in metrics and metrics["psnr"] == math.inf

    def test_without_the_package(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ssimulacra2", None)
        assert math.isnan(evaluate(make_scene(), make_scene().render())["ssimulacra2"])
