"""The least width of a Gaussian, against eigenvalues in float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcgs.optim.frame import widen


def covariance(cholesky: Tensor) -> Tensor:
    l11, l21, l22 = cholesky.double().unbind(-1)
    factor = torch.stack([torch.stack([l11, torch.zeros_like(l11)], -1), torch.stack([l21, l22], -1)], -2)
    return factor @ factor.mT


def test_raises_the_eigenvalues() -> None:
    generator = torch.Generator().manual_seed(0)
    cholesky = torch.rand(500, 3, generator=generator) * torch.tensor([2.0, 4.0, 2.0]) + torch.tensor([0.1, -2.0, 0.1])
    values, vectors = torch.linalg.eigh(covariance(cholesky))
    expected = vectors @ torch.diag_embed(values.clamp_min(0.25)) @ vectors.mT
    widened = widen(cholesky, 0.5)
    torch.testing.assert_close(covariance(widened), expected, rtol=1e-4, atol=1e-4)
    wide = values[:, 0] > 0.251
    assert 50 < int(wide.sum()) < 450
    assert torch.equal(widened[wide], cholesky[wide])


@pytest.mark.parametrize("sides", [(0.1, 0.1), (0.1, 1e4), (1e4, 0.1), (0.5, 0.5)])
def test_circles_and_needles(sides: tuple[float, float]) -> None:
    cholesky = torch.tensor([[sides[0], 0.0, sides[1]]])
    expected = torch.tensor([[max(sides[0], 0.5), 0.0, max(sides[1], 0.5)]])
    torch.testing.assert_close(widen(cholesky, 0.5), expected)
