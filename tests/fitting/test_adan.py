"""Adan against a float64 transcription of the published algorithm."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.fitting.gaussian_image import Adan

Array = NDArray[np.float64]
START = np.array([-1.2, 1.0, 0.3, -0.7])


def loss_of(point: Tensor) -> Tensor:
    """Rosenbrock's function of neighbouring coordinates, with a sine."""
    return (100 * (point[1:] - point[:-1] ** 2) ** 2 + (1 - point[:-1]) ** 2 + (3 * point[1:]).sin()).sum()


def gradient_of(point: Array) -> Array:
    """Its gradient by hand."""
    gradient = np.zeros_like(point)
    inner = point[1:] - point[:-1] ** 2
    gradient[:-1] += -400 * inner * point[:-1] - 2 * (1 - point[:-1])
    gradient[1:] += 200 * inner + 3 * np.cos(3 * point[1:])
    return gradient


def published(
    steps: int,
    lr: float = 1e-3,
    betas: tuple[float, float, float] = (0.98, 0.92, 0.99),
    eps: float = 1e-8,
) -> Array:
    """Algorithm 1 with the paper's beta = 1 - betas and its averages divided by their total weight."""
    theta = START.copy()
    beta1, beta2, beta3 = (1 - b for b in betas)
    m, v, n, before = np.zeros_like(theta), np.zeros_like(theta), np.zeros_like(theta), gradient_of(theta)
    for k in range(1, steps + 1):
        g = gradient_of(theta)
        m = (1 - beta1) * m + beta1 * g
        v = (1 - beta2) * v + beta2 * (g - before)
        n = (1 - beta3) * n + beta3 * (g + (1 - beta2) * (g - before)) ** 2
        m_hat, v_hat, n_hat = (
            average / (1 - (1 - beta) ** k) for average, beta in ((m, beta1), (v, beta2), (n, beta3))
        )
        theta = theta - lr / (np.sqrt(n_hat) + eps) * (m_hat + (1 - beta2) * v_hat)
        before = g
    return theta


@pytest.mark.parametrize("settings", [{}, {"lr": 0.02, "betas": (0.9, 0.5, 0.95), "eps": 1e-3}])
def test_matches_publication(settings: dict[str, Any]) -> None:
    point = torch.nn.Parameter(torch.tensor(START))
    optimizer = Adan([point], **settings)
    for _ in range(20):
        optimizer.zero_grad()
        loss_of(point).backward()
        optimizer.step()
    expected = published(20, **settings)
    assert np.abs(expected - START).max() > 0.5 * settings.get("lr", 1e-3)
    np.testing.assert_allclose(point.detach().numpy(), expected, rtol=0, atol=1e-13)
