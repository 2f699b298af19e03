"""Kornia's edge-aware losses and filters on the drawn picture: finite gradients, and a descent that lowers them."""

from __future__ import annotations

from collections.abc import Callable

import kornia
import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer

SIZE = (32, 40)
Loss = Callable[[Tensor, Tensor], Tensor]


def sobel(drawn: Tensor, target: Tensor) -> Tensor:
    return (kornia.filters.sobel(drawn) - kornia.filters.sobel(target)).abs().mean()


def gradient(drawn: Tensor, target: Tensor) -> Tensor:
    one, two = (kornia.filters.spatial_gradient(image, "sobel", order=1) for image in (drawn, target))
    return (one - two).square().mean()


def laplacian(drawn: Tensor, target: Tensor) -> Tensor:
    return (kornia.filters.laplacian(drawn, 5) - kornia.filters.laplacian(target, 5)).abs().mean()


def ssim(drawn: Tensor, target: Tensor) -> Tensor:
    return kornia.losses.ssim_loss(drawn, target, window_size=5)


def edge_aware_smoothness(drawn: Tensor, target: Tensor) -> Tensor:
    """Penalise slopes of the drawn brightness except where the target has edges, together with the difference."""
    smooth = kornia.losses.inverse_depth_smoothness_loss(drawn.mean(1, keepdim=True), target)
    return smooth + (drawn - target).square().mean()


LOSSES = [sobel, gradient, laplacian, ssim, edge_aware_smoothness]


@pytest.fixture
def target() -> Tensor:
    y, x = torch.meshgrid(torch.arange(SIZE[0]) + 0.5, torch.arange(SIZE[1]) + 0.5, indexing="ij")
    image = 0.3 + 0.3 * torch.stack([x / SIZE[1], y / SIZE[0], 1 - x / SIZE[1]])
    image[:, (x - 20) ** 2 + (y - 16) ** 2 < 81] = torch.tensor([0.9, 0.7, 0.2])[:, None]
    return image[None]


@pytest.fixture
def regions(target: Tensor) -> RegionMap:
    return RegionMap.from_labels((target[0, 0] > 0.8).long(), 0.6)


@pytest.mark.parametrize("loss", LOSSES)
def test_descent_lowers_the_loss(loss: Loss, target: Tensor, regions: RegionMap) -> None:
    field = GaussianField.random(60, SIZE, regions=regions, seed=0)
    render = RegionSplatRenderer()
    optimizer = torch.optim.Adam(field.parameters(), lr=0.02)
    values = []
    for _ in range(60):
        value = loss(render(field, regions)[None], target)
        optimizer.zero_grad()
        value.backward()
        for name, parameter in field.named_parameters():
            assert parameter.grad is not None and parameter.grad.isfinite().all(), name
            assert parameter.grad.any(), name
        optimizer.step()
        values.append(float(value.detach()))
    assert values[-1] < 0.5 * values[0]


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_are_finite_where_the_picture_is_flat(loss: Loss, target: Tensor, regions: RegionMap) -> None:
    """A black picture has no slope anywhere: roots of zero must not show."""
    field = GaussianField.random(60, SIZE, regions=regions, seed=0)
    with torch.no_grad():
        field.colors.zero_()
    loss(RegionSplatRenderer()(field, regions)[None], target).backward()
    for parameter in field.parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all()


def test_sobel_draws_the_contour(target: Tensor, regions: RegionMap) -> None:
    """Slopes alone, without a term in the colours, put the steps of the picture where they are in the target."""
    field = GaussianField.random(60, SIZE, regions=regions, seed=0)
    optimizer = torch.optim.Adam(field.parameters(), lr=0.03)
    for _ in range(150):
        loss = gradient(RegionSplatRenderer()(field, regions)[None], target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        drawn = RegionSplatRenderer()(field, regions)[None]
    slopes = torch.stack([kornia.filters.sobel(image).flatten() for image in (drawn, target)])
    assert torch.corrcoef(slopes)[0, 1] > 0.9
