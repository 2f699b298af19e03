"""Kornia before and after kcgs: a fit of what was augmented, and the renderer as the first link of a chain."""

from __future__ import annotations

import kornia
import kornia.augmentation as K
import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene, fit
from kcgs.functional import psnr
from kcgs.segment import segment


def photo() -> Tensor:
    """Draw a bright bar and a dark disc on a textured ground, (1, 3, 72, 88)."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 72), torch.linspace(0, 1, 88), indexing="ij")
    image = torch.stack([0.3 + 0.3 * x, 0.4 + 0.2 * y, 0.6 - 0.2 * x])
    image[:, (y > 0.55) & (y < 0.8)] = torch.tensor([0.9, 0.8, 0.2])[:, None]
    image[:, (x - 0.6) ** 2 + (y - 0.3) ** 2 < 0.03] = torch.tensor([0.15, 0.1, 0.3])[:, None]
    return (image + 0.06 * torch.sin(31 * x + 9 * y) * torch.cos(23 * y))[None].clamp(0, 1)


def test_augment_segment_fit_measure() -> None:
    torch.manual_seed(0)
    augment = nn.Sequential(
        K.RandomHorizontalFlip(p=1.0),
        K.RandomCrop((48, 64), p=1.0),
        K.ColorJiggle(0.1, 0.1, 0.1, 0.02, p=1.0),
    )
    image = augment(photo()).clamp(0, 1)
    assert image.shape == (1, 3, 48, 64)

    labels = segment(image[0])
    assert labels.shape == (48, 64)
    scene = fit(image, labels, num_gaussians=60, iterations=120).scene
    render = scene.render()

    quality = kornia.metrics.psnr(render, image, 1.0)
    assert quality > 40
    assert kornia.metrics.ssim(render, image, 5).mean() > 0.94
    torch.testing.assert_close(psnr(render, image).squeeze(), quality, rtol=1e-3, atol=1e-3)


LINKS = (
    kornia.filters.GaussianBlur2d((3, 3), (1.0, 1.0)),
    K.RandomHorizontalFlip(p=1.0),
    kornia.geometry.Resize((12, 18), antialias=True),
)


class TestFirstLink:
    """`nn.Sequential(RegionSplatRenderer(keepdim=False), ...)` of a scene, as Kornia chains its own modules."""

    SIZE = (24, 36)

    @pytest.fixture
    def scene(self) -> Scene:
        labels = torch.zeros(self.SIZE, dtype=torch.long)
        labels[6:18, 10:30] = 4
        regions = RegionMap(labels, 0.7)
        return Scene(GaussianField.random(60, self.SIZE, regions=regions, seed=0), regions)

    def test_one_scene_is_a_batch_of_one(self, scene: Scene) -> None:
        image = nn.Sequential(RegionSplatRenderer(clamp=True, keepdim=False), *LINKS)(scene)
        assert image.shape == (1, 3, 12, 18)
        image.square().sum().backward()
        for parameter in scene.parameters():
            assert parameter.grad is not None and parameter.grad.isfinite().all() and parameter.grad.any()

    def test_a_batch_stays_a_batch(self, scene: Scene) -> None:
        both = Scene(GaussianField.stack([scene.field, scene.field]), scene.regions)
        for keepdim in (False, True):
            assert nn.Sequential(RegionSplatRenderer(keepdim=keepdim), *LINKS)(both).shape == (2, 3, 12, 18)
