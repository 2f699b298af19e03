"""Kornia's edge-aware losses and filters on the drawn picture: finite gradients, and a descent that lowers them."""

from __future__ import annotations

from collections.abc import Callable

import kornia
import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.functional import region_splat
from tests.tester import BaseTester

SIZE = (32, 40)
Loss = Callable[[Tensor, Tensor], Tensor]


def sobel(image: Tensor, target: Tensor) -> Tensor:
    return (kornia.filters.sobel(image) - kornia.filters.sobel(target)).abs().mean()


def gradient(image: Tensor, target: Tensor) -> Tensor:
    one, two = (kornia.filters.spatial_gradient(image, "sobel", order=1) for image in (image, target))
    return (one - two).square().mean()


def laplacian(image: Tensor, target: Tensor) -> Tensor:
    return (kornia.filters.laplacian(image, 5) - kornia.filters.laplacian(target, 5)).abs().mean()


def ssim(image: Tensor, target: Tensor) -> Tensor:
    return kornia.losses.ssim_loss(image, target, window_size=5)


def edge_aware_smoothness(image: Tensor, target: Tensor) -> Tensor:
    """Penalise slopes of the drawn brightness except where the target has edges, together with the difference."""
    smooth = kornia.losses.inverse_depth_smoothness_loss(image.mean(1, keepdim=True), target)
    return smooth + (image - target).square().mean()


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


class TestEdgeLosses(BaseTester):
    """Kornia's filters and losses behind the renderer."""

    def scene(self, regions: RegionMap, device: torch.device, dtype: torch.dtype, count: int = 40) -> Scene:
        field = GaussianField.random(count, SIZE, regions=regions, seed=0)
        return Scene(field, regions).to(device, torch.promote_types(dtype, torch.float32))

    @pytest.mark.parametrize("loss", LOSSES)
    def test_smoke(
        self, loss: Loss, backend: str, device: torch.device, dtype: torch.dtype, target: Tensor, regions: RegionMap
    ) -> None:
        image = RegionSplatRenderer(backend=backend, keepdim=False)(self.scene(regions, device, dtype))
        value = loss(image, target.to(image))
        assert value.isfinite() and value > 0 and value.device.type == device.type and value.dtype == image.dtype

    @pytest.mark.parametrize("loss", LOSSES)
    @pytest.mark.parametrize("images", [1, 3])
    def test_cardinality(self, loss: Loss, images: int, device: torch.device, target: Tensor) -> None:
        """One number for a batch, which is rendered with a map for each image."""
        maps = torch.stack([(target[0, 0] > 0.8).roll(k, 1).long() for k in range(images)])
        tensors = [torch.rand(images, 20, n, generator=torch.Generator().manual_seed(n)) for n in (2, 3, 3)]
        field = GaussianField(30 * tensors[0], 1 + 3 * tensors[1], tensors[2], size=SIZE).assign_regions(maps)
        image = RegionSplatRenderer()(field.to(device), maps.to(device))
        assert image.shape == (images, 3, *SIZE) and loss(image, target.to(device).expand_as(image)).shape == ()

    @pytest.mark.parametrize("loss", LOSSES)
    def test_exception(self, loss: Loss, target: Tensor) -> None:
        """An image without a batch is refused aloud, or told from one with: `keepdim=False` gives one."""
        field = GaussianField.random(5, SIZE, seed=0)
        with pytest.raises((TypeError, ValueError, RuntimeError, IndexError)):
            loss(RegionSplatRenderer()(field), target)
        assert loss(RegionSplatRenderer(keepdim=False)(field), target) > 0

    @pytest.mark.parametrize("loss", LOSSES)
    def test_gradcheck(self, loss: Loss, target: Tensor) -> None:
        field, small = GaussianField.random(6, (12, 16), seed=0), target[..., 10:22, 16:32].double()

        def draw(*tensors: Tensor) -> Tensor:
            return loss(region_splat(*tensors, size=(12, 16), cutoff=0, backend="tiled")[None], small)

        self.gradcheck(draw, (field.means, field.cholesky, field.colors))

    @pytest.mark.parametrize("loss", LOSSES)
    def test_dynamo(
        self, loss: Loss, device: torch.device, dtype: torch.dtype, target: Tensor, regions: RegionMap
    ) -> None:
        scene, render = self.scene(regions, device, dtype), RegionSplatRenderer(keepdim=False)
        goal = target.to(scene.field.colors)
        self.assert_compiles(lambda: loss(render(scene), goal), leaves=list(scene.parameters()), rtol=1e-3, atol=1e-5)

    def test_module(self, device: torch.device, dtype: torch.dtype, target: Tensor, regions: RegionMap) -> None:
        """Filters as links of a chain behind the renderer."""
        scene = self.scene(regions, device, dtype)
        links = nn.Sequential(RegionSplatRenderer(keepdim=False), kornia.filters.Sobel(), kornia.filters.Laplacian(5))
        expected = kornia.filters.laplacian(kornia.filters.sobel(scene()[None]), 5)
        self.assert_close(links(scene), expected)

    @pytest.mark.parametrize("loss", LOSSES)
    def test_feature(self, loss: Loss, target: Tensor, regions: RegionMap) -> None:
        """Descent on a loss lowers it, through all tensors of the field."""
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
    def test_gradients_are_finite_where_the_picture_is_flat(
        self, loss: Loss, target: Tensor, regions: RegionMap
    ) -> None:
        """A black picture has no slope anywhere: roots of zero must not show."""
        field = GaussianField.random(60, SIZE, regions=regions, seed=0)
        with torch.no_grad():
            field.colors.zero_()
        loss(RegionSplatRenderer()(field, regions)[None], target).backward()
        for parameter in field.parameters():
            assert parameter.grad is not None and parameter.grad.isfinite().all()
