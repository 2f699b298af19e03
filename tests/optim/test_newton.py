"""Newton's method for every number alone."""

from __future__ import annotations

import math

import pytest
import torch

from kcgs import GaussianField
from kcgs.optim import Gaussians, NewtonDescent, Renderer, SquaredError

SIZE = (32, 40)
RENDERER = Renderer(SIZE, cutoff=0.0, backend="reference")


def round_gaussians(sigma: float, colors: list[float], x: float = 20.0) -> Gaussians:
    count = len(colors)
    cholesky = torch.tensor([[sigma, 0.0, sigma]]).expand(count, 3).double()
    means = torch.tensor([[x + 15 * k, 16.0] for k in range(count)], dtype=torch.float64)
    return Gaussians(means, cholesky.clone(), torch.tensor(colors, dtype=torch.float64)[:, None])


def test_a_step_of_a_colour_is_the_least_squares_one() -> None:
    """Alone, a colour is right after one whole step; where it has no other error, nothing else moves."""
    image = RENDERER.render(round_gaussians(3.0, [0.9]))
    descent = NewtonDescent(round_gaussians(3.0, [0.4]), SquaredError(image), RENDERER)
    descent.step(1.0)
    assert float(descent.gaussians.colors) == pytest.approx(0.9, abs=1e-3)
    torch.testing.assert_close(descent.gaussians.means, round_gaussians(3.0, [0.4]).means)


@pytest.mark.parametrize("exact", [True, False])
def test_converges_to_the_image(exact: bool) -> None:
    target = GaussianField.random(6, SIZE, seed=0, sigma=4.0, dtype=torch.float64)
    image, start = RENDERER.render(Gaussians.of(target)), Gaussians.of(target)
    start = start._replace(means=start.means + 0.4, colors=0.8 * start.colors)
    descent = NewtonDescent(start, SquaredError(image), RENDERER, exact=exact)
    before = float(descent.objective.value(RENDERER.render(start)))
    for _ in range(120):
        descent.step(0.09)
    assert float(descent.objective.value(RENDERER.render(descent.gaussians))) < 1e-2 * before
    assert descent.iteration == 120


def test_frozen_numbers_stay_and_sigmas_have_a_bound() -> None:
    image = RENDERER.render(round_gaussians(0.3, [0.9, 0.9], x=10.0))
    start = round_gaussians(1.5, [0.4, 0.4], x=10.4)
    descent = NewtonDescent(start, SquaredError(image), RENDERER, min_sigma=1.2)
    descent.frozen = torch.tensor([[True], [False]])
    for _ in range(40):
        descent.step(0.1)
    for table, first in zip(descent.gaussians[:3], start[:3], strict=True):
        assert torch.equal(table[0], first[0]) and not torch.equal(table[1], first[1])
    l11, l21, l22 = descent.gaussians.cholesky[1].tolist()
    factor = torch.tensor([[l11, 0.0], [l21, l22]], dtype=torch.float64)
    assert float(torch.linalg.svdvals(factor)[1]) == pytest.approx(1.2, rel=1e-6) and math.isfinite(l21)
