"""Objectives but MS-SSIM, which has its own file: slopes against autograd, values, residuals."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField
from kcgs.optim import Gaussians, Renderer
from kcgs.optim.objectives import AbsoluteError, ImageObjective, LossObjective, Objective, SquaredError

IMAGE = torch.rand(3, 24, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
RENDER = 0.8 * IMAGE + 0.1 + 0.05 * torch.rand(3, 24, 40, generator=torch.Generator().manual_seed(1)).double()
WEIGHT = torch.rand(24, 40, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def mean_fourth_power(render: Tensor) -> Tensor:
    return (render - IMAGE).pow(4).mean()


def autograd(objective: Objective) -> Tensor:
    """The gradient of the value, times the number of values."""
    leaf = RENDER.clone().requires_grad_()
    value = objective.loss(leaf[None]) if isinstance(objective, LossObjective) else objective.value(leaf)
    return torch.autograd.grad(value, leaf)[0] * leaf.numel()


@pytest.mark.parametrize(
    ("objective", "factor"),
    [
        (SquaredError(IMAGE), 0.5),
        (SquaredError(IMAGE, weight=WEIGHT), 0.5),
        (AbsoluteError(IMAGE), 1.0),
        (LossObjective(mean_fourth_power), 1.0),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Objective) else str(value),
)
def test_the_slope_is_the_gradient_times_a_factor(objective: Objective, factor: float) -> None:
    torch.testing.assert_close(objective.slope(RENDER.clone()), factor * autograd(objective))


@pytest.mark.parametrize(("kind", "power"), [(SquaredError, 2), (AbsoluteError, 1)])
def test_values_with_a_power_are_means_of_it(kind: type[SquaredError | AbsoluteError], power: int) -> None:
    objective = kind(IMAGE)
    assert objective.power == power
    torch.testing.assert_close(objective.value(RENDER), (RENDER - IMAGE).abs().pow(power).mean())
    assert SquaredError(IMAGE, weight=WEIGHT).power is None


@pytest.mark.parametrize("kind", [SquaredError, AbsoluteError])
def test_a_batch_is_as_each_image_alone(kind: type[ImageObjective]) -> None:
    images, renders = torch.stack([IMAGE, IMAGE.flip(1)]).float(), torch.stack([RENDER, 1 - RENDER]).float()
    batch = kind(images)
    values, slopes = batch.value(renders), batch.slope(renders.clone())
    for k in range(2):
        alone = kind(images[k])
        torch.testing.assert_close(values[k], alone.value(renders[k]))
        torch.testing.assert_close(slopes[k], alone.slope(renders[k].clone()), atol=1e-5, rtol=1e-5)


class TestLoss:
    def test_the_residual_is_what_the_image_has_more(self) -> None:
        torch.testing.assert_close(LossObjective(mean_fourth_power, IMAGE).residual(RENDER).error, IMAGE - RENDER)

    def test_without_an_image_the_residual_lowers_the_loss(self) -> None:
        objective = LossObjective(mean_fourth_power)
        error = objective.residual(RENDER).error
        assert float(error.abs().max()) == pytest.approx(2.0 ** round(math.log2(float(error.abs().max()))))
        assert objective.value(RENDER + error) < objective.value(RENDER)

    def test_a_slope_of_zero_leaves_no_residual(self) -> None:
        assert torch.equal(LossObjective(lambda render: 0.0 * render.sum()).residual(RENDER).error, 0.0 * RENDER)

    def test_what_is_no_loss_is_refused(self) -> None:
        for loss, words in (
            (lambda render: render, r"a function that returns a scalar tensor; got shape \(3, 24, 40\)"),
            (lambda render: 1.0, "a function that returns a scalar tensor; got float"),
            (lambda render: torch.zeros(()), "a loss that depends on the render"),
        ):
            with pytest.raises(ValueError, match=f"objective must be {words}"):
                LossObjective(loss).slope(RENDER)


def test_gradients_take_no_function_that_loads_sympy(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would take 0.4 s of each process."""
    gaussians = Gaussians.of(GaussianField.random(3, (24, 40), seed=0))
    monkeypatch.delattr(torch.autograd, "grad")
    gradients = AbsoluteError(IMAGE.float()).gradients(Renderer((24, 40)), gaussians)
    assert all(table.any() for table in gradients[:3])
