"""Metrics of a scene against an image."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene, evaluate
from kcgs.functional import METRICS, ef_psnr, psnr, ssim

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
        assert metrics.keys() == METRICS.keys()

    def test_labels_have_the_contours(self) -> None:
        scene, image = make_scene(None), torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0))
        assert math.isnan(evaluate(scene, image)["ef_psnr"])
        soft = RegionMap(LABELS, 0.7)
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
    def test_left_out(self) -> None:
        metrics = evaluate(make_scene(), make_scene().render(), with_ssimulacra2=False)
        assert metrics.keys() == METRICS.keys() - {"ssimulacra2"} and metrics["psnr"] == math.inf

    def test_without_the_package(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ssimulacra2", None)
        assert math.isnan(evaluate(make_scene(), make_scene().render())["ssimulacra2"])
