"""Stiff and extreme scenes: finite, and within a stated bound of float64; or a clear ValueError."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs.functional import region_splat, scale_rotation_to_cholesky

FAST = ["tiled", "cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SIZE = (40, 50)


def splat(scene: list[Tensor], *regions: Tensor, backend: str, **settings: Any) -> Tensor:
    """Render on the backend's device; tensors come from the CPU, and so does the image."""
    device = "cuda" if backend == "cuda" else "cpu"
    return region_splat(*(t.to(device) for t in (*scene, *regions)), backend=backend, **settings).cpu()


def render(backend: str, scene: list[Tensor]) -> list[Tensor]:
    """Return the image and the gradients, of the reference in float64, of others in float32."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    inputs = [t.detach().to(dtype).requires_grad_() for t in scene]
    image = splat(inputs, size=SIZE, cutoff=0, backend=backend)
    probe = torch.cos(torch.linspace(0, 60, image.numel(), dtype=torch.float64)).view_as(image)
    return [image.detach().double(), *(g.double() for g in torch.autograd.grad((image.double() * probe).sum(), inputs))]


def errors(backend: str, scene: list[Tensor]) -> tuple[float, float, float]:
    """Return the image error, the gradient error relative to each component's largest, and 1 - cosine."""
    result, expected = render(backend, scene), render("reference", scene)
    assert all(torch.isfinite(t).all() for t in result)
    gradient, angle = 0.0, 0.0
    for g, w in zip(result[1:], expected[1:], strict=True):
        gradient = max(gradient, float(((g - w).abs() / w.abs().amax(0).clamp_min(1e-12)).max()))
        if w.norm() > 1e-9:
            angle = max(angle, 1 - float(torch.nn.functional.cosine_similarity(g.flatten(), w.flatten(), dim=0)))
    return float((result[0] - expected[0]).abs().max()), gradient, angle


def centres(count: int) -> Tensor:
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([50.0, 40.0])


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("anisotropy", [1.0, 1e6])
@pytest.mark.parametrize("sigma", [0.05, 1.0, 1e4])
def test_sigma_and_anisotropy_at_every_angle(backend: str, sigma: float, anisotropy: float) -> None:
    """Image within 1e-5 a Gaussian, gradients within 1e-3; whitened coordinates keep both, however thin."""
    long = min(sigma * anisotropy, 5e7)
    angle = torch.cat([torch.linspace(0, math.pi, 17), torch.tensor([1e-7, math.pi / 2 - 1e-7])]).double()
    scales = torch.tensor([long, sigma], dtype=torch.float64).expand(19, 2)
    cholesky = scale_rotation_to_cholesky(scales, angle).float()
    image, gradient, angle_error = errors(backend, [centres(19), cholesky, torch.ones(19, 2)])
    assert image < 1e-5 * 19
    assert gradient < 1e-3
    assert angle_error < 1e-6


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("size", [1e-8, 1e6])
def test_colours_of_any_size(backend: str, size: float) -> None:
    cholesky = torch.tensor([[3.0, 1.0, 2.0]]).repeat(30, 1)
    image, gradient, _ = errors(backend, [centres(30), cholesky, size * torch.rand(30, 3)])
    assert image < 1e-5 * size
    assert gradient < 1e-5


@pytest.mark.parametrize("backend", FAST)
def test_centres_far_away(backend: str) -> None:
    distance, angle = 1e7, torch.linspace(0, 2 * math.pi, 13)
    means = distance * torch.stack([angle.cos(), angle.sin()], -1)
    cholesky = torch.tensor([[distance, 0.3 * distance, distance / 2]]).repeat(13, 1)
    image, gradient, _ = errors(backend, [means, cholesky, torch.ones(13, 1)])
    assert image < 1e-5
    assert gradient < 1e-4


@pytest.mark.parametrize(
    ("backend", "dtype"),
    [("tiled", torch.float32), ("tiled", torch.float64), *((name, torch.float32) for name in FAST[1:])],
)
def test_weights_that_are_nothing(backend: str, dtype: torch.dtype) -> None:
    """Below e^-80, in float64 e^-700, a weight is 0, whatever it is multiplied by."""
    scene = [torch.full((1, 2), 0.5), torch.tensor([[0.2, 0.0, 0.2]]), torch.full((1, 1), 1e30)]
    leaves = [t.to(dtype).requires_grad_() for t in scene]
    image = splat(leaves, size=(16, 16), cutoff=0, backend=backend)
    far = image[:, 8:, 8:]
    assert image.any() and not far.any()
    assert not any(gradient.any() for gradient in torch.autograd.grad(far.sum(), leaves))


@pytest.mark.parametrize("backend", FAST)
def test_thousands_of_regions_of_a_pixel(backend: str) -> None:
    labels = torch.arange(128 * 128).view(128, 128)
    ids = torch.arange(0, labels.numel(), 7)
    colors = 0.1 + torch.rand(len(ids), 1, generator=torch.Generator().manual_seed(0))
    cholesky = torch.tensor([[4.0, 0.0, 4.0]]).repeat(len(ids), 1)
    means = torch.stack([ids % 128, ids // 128], -1) + 0.5
    image = splat([means, cholesky, colors], ids, labels, backend=backend).flatten()
    torch.testing.assert_close(image[ids], colors[:, 0], rtol=1e-3, atol=1e-6)
    assert int(image.count_nonzero()) == len(ids)


@pytest.mark.parametrize("backend", FAST)
def test_a_wide_image(backend: str) -> None:
    height, width = 64, 7680
    means = torch.tensor([[7000.3, 40.7], [100.0, 63.5], [3840.0, 20.0]])
    cholesky = torch.tensor([[30.0, 10.0, 20.0], [50.0, 0.0, 3.0], [400.0, -300.0, 200.0]])
    image = splat([means, cholesky, torch.ones(3, 1)], size=(height, width), backend=backend)
    assert torch.isfinite(image).all()
    for (mx, my), factor in zip(means.double(), cholesky.double(), strict=True):
        x, y = int(mx), min(int(my), height - 1)
        window = image[0, y, x]
        z1 = (x + 0.5 - mx) / factor[0]
        z2 = (y + 0.5 - my - factor[1] * z1) / factor[2]
        assert float(window) == pytest.approx(float(torch.exp(-0.5 * (z1**2 + z2**2))), abs=1e-4)


@pytest.mark.parametrize("backend", FAST)
def test_error_at_the_default_cutoff(backend: str) -> None:
    """Under 1e-3 in the image and 2e-3, relative, in the gradients."""
    generator = torch.Generator().manual_seed(0)
    n = 150
    means = torch.rand(n, 2, generator=generator) * torch.tensor([120.0, 90.0])
    cholesky = (torch.rand(n, 3, generator=generator) + 0.4) * 6
    scene = [means, cholesky, torch.rand(n, 3, generator=generator)]
    images, grads = [], []
    for name, cutoff, dtype in ((backend, 1e-4, torch.float32), ("reference", 0.0, torch.float64)):
        inputs = [t.detach().clone().to(dtype).requires_grad_() for t in scene]
        image = splat(inputs, size=(90, 120), cutoff=cutoff, backend=name)
        (image * torch.cos(torch.linspace(0, 60, image.numel(), dtype=dtype)).view_as(image)).sum().backward()
        images.append(image.detach().double())
        grads.append([t.grad.double() for t in inputs if t.grad is not None])
    assert 1e-6 < (images[0] - images[1]).abs().max() < 1e-3
    for g, w in zip(*grads, strict=True):
        assert (g - w).abs().max() < 2e-3 * w.abs().max()
