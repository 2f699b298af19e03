"""Error against stiffness: needles turned through all angles, held against float64."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import region_splat, scale_rotation_to_cholesky

SIZE = (96, 128)
ANISOTROPIES = (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
SIGMAS = (0.05, 0.5, 5.0)


class Stiffness(NamedTuple):
    """Largest error of the image, relative to a colour of 1, and of the gradients, relative to their largest."""

    backend: str
    sigma: float
    anisotropy: float
    image: float
    gradient: float


def sweep(backends: list[str]) -> list[Stiffness]:
    """Measure every backend at every stiffness."""
    rows = []
    for sigma in SIGMAS:
        for anisotropy in ANISOTROPIES:
            scene = needles(sigma, anisotropy)
            want, want_gradients = _draw([t.double() for t in scene], "reference")
            for backend in backends:
                got, gradients = _draw(scene, backend)
                rows.append(
                    Stiffness(
                        backend,
                        sigma,
                        anisotropy,
                        float((got - want).abs().max()),
                        max(_relative(g, w) for g, w in zip(gradients, want_gradients, strict=True)),
                    )
                )
    return rows


def needles(sigma: float, anisotropy: float, count: int = 37) -> list[Tensor]:
    """Make Gaussians of one shape turned from 0 to pi, the singular angles among them; float32."""
    angle = torch.linspace(0, math.pi, count, dtype=torch.float64)
    scales = torch.tensor([sigma * anisotropy, sigma], dtype=torch.float64).expand(count, 2)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 2, generator=generator) * torch.tensor([SIZE[1], SIZE[0]])
    cholesky = scale_rotation_to_cholesky(scales, angle).float()
    return [means, cholesky, torch.ones(count, 1)]


def _draw(scene: list[Tensor], backend: str) -> tuple[Tensor, list[Tensor]]:
    inputs = [t.clone().requires_grad_() for t in scene]
    image = region_splat(inputs[0], inputs[1], inputs[2], size=SIZE, cutoff=0, backend=backend)
    probe = torch.cos(torch.linspace(0, 60, image.numel(), dtype=image.dtype)).view_as(image)
    image.backward(probe)
    return image.detach(), [t.grad for t in inputs if t.grad is not None]


def _relative(got: Tensor, want: Tensor) -> float:
    # by component: a needle's two directions differ by its anisotropy
    scale = want.abs().amax(0).clamp_min(1e-12)
    return float(((got - want).abs() / scale).max())
