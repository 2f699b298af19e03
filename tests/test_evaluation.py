"""Figures of a scene against an image."""

from __future__ import annotations

import math
import sys
from pathlib import Path

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


def test_figures_are_those_of_the_clipped_render() -> None:
    scene, image = make_scene(), torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0))
    figures = evaluate(scene, image)
    render = scene.render()
    assert figures["psnr"] == float(psnr(render, image)) and figures["ssim"] == float(ssim(render, image))
    assert figures["ef_psnr"] == float(ef_psnr(render, image, LABELS)) and math.isnan(figures["ms_ssim"])
    assert list(figures) == ["psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim", "ssimulacra2"]


def test_arrays_and_pil_images_are_images() -> None:
    levels = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    expected = evaluate(make_scene(), torch.from_numpy(levels).permute(2, 0, 1).float() / 255)
    np.testing.assert_equal(evaluate(make_scene(), levels), expected)
    np.testing.assert_equal(evaluate(make_scene(), Image.fromarray(levels)), expected)


def test_labels_say_where_contours_are() -> None:
    image = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0))
    assert math.isnan(evaluate(make_scene(None), image)["ef_psnr"])
    given = evaluate(make_scene(None), image, RegionMap.from_labels(LABELS, 0.7))
    for same in (LABELS, LABELS.bool(), LABELS.numpy(), LABELS[None]):
        assert given["ef_psnr"] == evaluate(make_scene(None), image, same)["ef_psnr"] > 0


class TestVisual:
    def test_values(self, tmp_path: Path) -> None:
        package = pytest.importorskip("ssimulacra2", reason="SSIMULACRA2 needs the package ssimulacra2")
        photo = torch.from_numpy(skimage.data.astronaut()[:256, :240].copy()).permute(2, 0, 1).float() / 255
        assert ssimulacra2(photo, photo) == 100
        save_image(tmp_path / "photo.png", photo)
        found = []
        for quality in (90, 50, 10):
            Image.open(tmp_path / "photo.png").save(tmp_path / f"{quality}.jpg", quality=quality)
            found.append(ssimulacra2(load_image(tmp_path / f"{quality}.jpg"), photo))
            want = package.compute_ssimulacra2(tmp_path / "photo.png", tmp_path / f"{quality}.jpg")
            assert found[-1] == pytest.approx(want, abs=1e-9)
        assert 100 > found[0] > 70 > found[1] > 40 > found[2]
        grey, shown = photo[:1], photo[:1] * 0.9
        assert ssimulacra2(shown, grey) == ssimulacra2(shown.expand(3, -1, -1), grey.expand(3, -1, -1)) < 100

    def test_not_defined(self) -> None:
        assert all(math.isnan(ssimulacra2(t, t)) for t in (torch.ones(3, 7, 60), torch.ones(4, 40, 60)))

    def test_left_out(self) -> None:
        figures = evaluate(make_scene(), make_scene().render(), visual=False)
        assert "ssimulacra2" not in figures and figures["psnr"] == math.inf

    def test_without_the_package(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ssimulacra2", None)
        assert math.isnan(evaluate(make_scene(), make_scene().render())["ssimulacra2"])


def test_bad_input() -> None:
    with pytest.raises(ValueError, match=r"image must have the scene's shape \(3, 40, 60\); got \(3, 40, 61\)"):
        evaluate(make_scene(), torch.zeros(3, 40, 61))
    with pytest.raises(TypeError, match="scene must be a Scene; got GaussianField"):
        evaluate(make_scene().field, torch.zeros(3, 40, 60))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="labels must be a RegionMap"):
        evaluate(make_scene(), torch.zeros(3, 40, 60), "mask.png")  # type: ignore[arg-type]
