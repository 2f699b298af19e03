"""Figures of a scene against an image."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from PIL import Image

from kcgs import GaussianField, RegionMap, Scene, evaluate
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
    assert list(figures) == ["psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim"]


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


def test_bad_input() -> None:
    with pytest.raises(ValueError, match=r"image must have the scene's shape \(3, 40, 60\); got \(3, 40, 61\)"):
        evaluate(make_scene(), torch.zeros(3, 40, 61))
    with pytest.raises(TypeError, match="scene must be a Scene; got GaussianField"):
        evaluate(make_scene().field, torch.zeros(3, 40, 60))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="labels must be a RegionMap"):
        evaluate(make_scene(), torch.zeros(3, 40, 60), "mask.png")  # type: ignore[arg-type]
