"""Forms of a covariance agree with linear algebra, round trip, and hold where they are stiff."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs.functional import (
    cholesky_to_covariance,
    cholesky_to_scale_rotation,
    covariance_to_cholesky,
    scale_rotation_to_cholesky,
)


@pytest.fixture
def factors() -> Tensor:
    generator = torch.Generator().manual_seed(0)
    l = torch.rand(50, 3, generator=generator, dtype=torch.float64) * 5 + 0.1  # noqa: E741
    return l * torch.tensor([1.0, -1.0, 1.0])


def triangle(factors: Tensor) -> Tensor:
    zero = torch.zeros_like(factors[..., 0])
    return torch.stack([factors[..., 0], zero, factors[..., 1], factors[..., 2]], -1).unflatten(-1, (2, 2))


class TestForms:
    def test_covariance(self, factors: Tensor) -> None:
        lower = triangle(factors)
        torch.testing.assert_close(cholesky_to_covariance(factors), lower @ lower.mT)

    def test_round_trip(self, factors: Tensor) -> None:
        torch.testing.assert_close(covariance_to_cholesky(cholesky_to_covariance(factors)), factors)

    def test_scale_rotation(self, factors: Tensor) -> None:
        scales, angle = cholesky_to_scale_rotation(factors)
        expected = torch.linalg.svdvals(triangle(factors))
        torch.testing.assert_close(scales, expected)
        torch.testing.assert_close(scale_rotation_to_cholesky(scales, angle), factors)

    @pytest.mark.parametrize("angle", [1e-9, math.pi / 2, 2.0])
    def test_needle_in_float32(self, angle: float) -> None:
        scales = torch.tensor([1e3, 1e-1])
        cholesky = scale_rotation_to_cholesky(scales, torch.tensor(angle))
        exact = scale_rotation_to_cholesky(scales.double(), torch.tensor(angle, dtype=torch.float32).double())
        torch.testing.assert_close(cholesky.double(), exact, rtol=1e-5, atol=1e-5)
        back, _ = cholesky_to_scale_rotation(cholesky)
        torch.testing.assert_close(back, scales, rtol=1e-4, atol=1e-6)


class TestErrors:
    @pytest.mark.parametrize(
        ("value", "error", "words"),
        [
            (torch.zeros(3), ValueError, "l11 > 0"),
            (torch.ones(2), ValueError, "shape"),
            (torch.ones(3).long(), TypeError, "floating"),
            (torch.tensor([1.0, math.nan, 1.0]), ValueError, "finite"),
            (None, TypeError, "Tensor"),
        ],
    )
    def test_cholesky(self, value: Any, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=f"cholesky must.*{words}"):
            cholesky_to_covariance(value)

    def test_covariance_not_positive(self) -> None:
        with pytest.raises(ValueError, match="covariance must be positive definite"):
            covariance_to_cholesky(torch.tensor([[1.0, 2.0], [2.0, 1.0]]))

    def test_scales(self) -> None:
        with pytest.raises(ValueError, match="scales must be positive"):
            scale_rotation_to_cholesky(torch.tensor([1.0, 0.0]), torch.tensor(0.0))
        with pytest.raises(ValueError, match="angle must have shape"):
            scale_rotation_to_cholesky(torch.ones(2, 2), torch.zeros(3))
