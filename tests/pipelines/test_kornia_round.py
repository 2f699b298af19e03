"""Augment with Kornia, segment, fit, draw, measure with Kornia: one pipeline of torch tensors."""

from __future__ import annotations

import kornia
import kornia.augmentation as K
import pytest
import torch
from torch import Tensor, nn

from kcgs import fit
from kcgs.functional import psnr
from kcgs.segment import segment


@pytest.fixture(scope="module")
def photo() -> Tensor:
    """Draw a bright bar and a dark disc on a textured ground, (1, 3, 72, 88)."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 72), torch.linspace(0, 1, 88), indexing="ij")
    image = torch.stack([0.3 + 0.3 * x, 0.4 + 0.2 * y, 0.6 - 0.2 * x])
    image[:, (y > 0.55) & (y < 0.8)] = torch.tensor([0.9, 0.8, 0.2])[:, None]
    image[:, (x - 0.6) ** 2 + (y - 0.3) ** 2 < 0.03] = torch.tensor([0.15, 0.1, 0.3])[:, None]
    return (image + 0.06 * torch.sin(31 * x + 9 * y) * torch.cos(23 * y))[None].clamp(0, 1)


@pytest.mark.parametrize("method", ["felzenszwalb", "auto"])
def test_augment_segment_fit_draw_measure(photo: Tensor, method: str) -> None:
    torch.manual_seed(0)
    augment = nn.Sequential(
        K.RandomHorizontalFlip(p=1.0),
        K.RandomCrop((48, 64), p=1.0),
        K.ColorJiggle(0.1, 0.1, 0.1, 0.02, p=1.0),
    )
    image = augment(photo).clamp(0, 1)
    assert image.shape == (1, 3, 48, 64)

    labels = segment(image[0], method)
    assert labels.shape == (48, 64)
    scene = fit(image, labels, num_gaussians=60, iterations=120).scene
    render = scene.render()[None]

    quality = kornia.metrics.psnr(render, image, 1.0)
    assert quality > 35
    assert kornia.metrics.ssim(render, image, 5).mean() > 0.94
    torch.testing.assert_close(psnr(render, image).squeeze(), quality, rtol=1e-3, atol=1e-3)
    # the scene and its labels go on through the same augmentation as any image does
    flipped = K.RandomHorizontalFlip(p=1.0)(render)
    torch.testing.assert_close(flipped, render.flip(-1))


def test_labels_follow_a_geometric_augmentation(photo: Tensor) -> None:
    """Image and label map are rotated as one; the fit on the pair beats the fit without labels at the same count."""
    torch.manual_seed(0)
    labels = segment(photo[0], "felzenszwalb")
    both = K.AugmentationSequential(K.RandomRotation((20.0, 20.0), p=1.0), data_keys=["image", "mask"])
    image, turned = both(photo, labels[None, None].float())
    image, turned = K.CenterCrop((40, 48))(image).clamp(0, 1), K.CenterCrop((40, 48), resample="nearest")(turned)
    quality = []
    for regions in (turned[0, 0].round().long(), None):
        scene = fit(image, regions, num_gaussians=24, iterations=80).scene
        render = scene.render()[None]
        quality.append(float(kornia.metrics.psnr(render, image, 1.0)))
    assert quality[0] > quality[1] + 1
