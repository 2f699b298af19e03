"""A photo's crop, with a map that its contour separates, and a fit of it."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from kcgs import Scene, fit

Photo = tuple[Tensor, Tensor]


def psnr(scene: Scene, image: Tensor) -> float:
    return -10 * math.log10(float((scene.render() - image).square().mean()))


def min_sigma(scene: Scene) -> float:
    """Return the least standard deviation of a scene's Gaussians, in pixels."""
    l11, l21, l22 = scene.field.cholesky.detach().unbind(-1)
    factors = torch.stack([torch.stack([l11, torch.zeros_like(l11)], -1), torch.stack([l21, l22], -1)], -2)
    return float(torch.linalg.svdvals(factors).min())


@pytest.fixture(scope="package")
def photo(astronaut: Tensor) -> Photo:
    """A crop with two regions that its contour separates: face and background."""
    image = torch.nn.functional.avg_pool2d(astronaut[None, :, :240, 100:420], 2)[0]
    row, column = torch.meshgrid(torch.arange(120), torch.arange(160), indexing="ij")
    return image, (((column - 62) / 30.0) ** 2 + ((row - 55) / 45.0) ** 2 < 1).long()


@pytest.fixture(scope="package")
def scene(photo: Photo) -> Scene:
    image, labels = photo
    result = fit(image, labels, 300, iterations=100, merge_regions=False)
    assert result.scene.regions is not None
    return result.scene
