"""Adan against a float64 transcription of the published algorithm, and as a torch optimiser."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcgs.fitting.gaussian_image import Adan

Array = NDArray[np.float64]
START = np.array([-1.2, 1.0, 0.3, -0.7])
SETTINGS: list[dict[str, Any]] = [
    {},
    {"lr": 0.05},
    {"lr": 0.02, "betas": (0.9, 0.5, 0.95), "eps": 1e-3},
    {"lr": 0.01, "betas": (0.0, 0.0, 0.0)},
]


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


def advance(optimizer: Adan, point: Tensor, steps: int) -> None:
    for _ in range(steps):
        optimizer.zero_grad()
        loss_of(point).backward()
        optimizer.step()


def parameter(dtype: torch.dtype = torch.float64) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.tensor(START, dtype=dtype))


class TestAlgorithm:
    @pytest.mark.parametrize("settings", SETTINGS)
    @pytest.mark.parametrize("steps", [1, 2, 20])
    def test_matches_publication(self, settings: dict[str, Any], steps: int) -> None:
        point = parameter()
        advance(Adan([point], **settings), point, steps)
        expected = published(steps, **settings)
        assert np.abs(expected - START).max() > 0.5 * settings.get("lr", 1e-3)
        np.testing.assert_allclose(point.detach().numpy(), expected, rtol=0, atol=1e-13)


class TestOptimizer:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_resumes_bit_for_bit(self, dtype: torch.dtype) -> None:
        straight = parameter(dtype)
        advance(Adan([straight], **SETTINGS[2]), straight, 20)

        first = parameter(dtype)
        optimizer = Adan([first], **SETTINGS[2])
        advance(optimizer, first, 7)
        saved = copy.deepcopy(optimizer.state_dict())
        second = torch.nn.Parameter(first.detach().clone())
        advance(optimizer, first, 3)  # the saved state must not move along

        restored = Adan([second])
        restored.load_state_dict(saved)
        assert restored.param_groups[0]["betas"] == SETTINGS[2]["betas"]
        advance(restored, second, 13)
        assert torch.equal(second, straight)
