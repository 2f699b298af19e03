"""Steps that tests/test_triton.py takes in a process of its own: on a GPU, or with TRITON_INTERPRET=1 in numpy."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField
from kcgs.optim import GaussianAdam, adam

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
SIZE = (24, 36)


@pytest.fixture(autouse=True)
def launches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Take the steps of float32 tables by the kernel, and none of a gradient that is not finite; count launches."""
    counts, launch = [], adam._launch

    def counted_launch(*arguments: object) -> None:
        counts.append(1)
        launch(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(adam, "_launch", counted_launch)
    monkeypatch.setattr(adam, "_checks_gradients", lambda parameter: False)
    if DEVICE.type == "cpu":
        takes_triton = lambda *tensors: all(t.dtype is torch.float32 for t in tensors)  # noqa: E731
        monkeypatch.setattr(adam, "takes_triton", takes_triton)
    return counts


def field_of(kind: str) -> GaussianField:
    field = GaussianField.random(20, SIZE, channels=5 if kind == "batch" else 3, seed=1)
    tensors = [field.means.detach(), field.cholesky.detach(), field.colors.detach()]
    if kind == "batch":
        tensors = [torch.stack([tensor, 0.9 * tensor]) for tensor in tensors]
    opacities = torch.full((20,), 0.7) if kind == "opacities" else None
    field = GaussianField(*tensors, None, opacities, size=SIZE)
    if kind == "frozen":
        field.cholesky.requires_grad_(False)
        field.means.data[0] = -300.0
    return field.to(DEVICE)


def give_gradients(generator: torch.Generator, *fields: GaussianField) -> None:
    """Give the same random gradients to all fields, each in its own precision."""
    for parameters in zip(*(field.parameters() for field in fields), strict=True):
        gradient = torch.randn(parameters[0].shape, generator=generator).to(DEVICE)
        for parameter in parameters:
            parameter.grad = gradient.to(parameter, copy=True) if parameter.requires_grad else None


def states(optimizer: GaussianAdam) -> list[Tensor]:
    return [values for state in optimizer.state.values() for values in state.values()]


@pytest.mark.parametrize("kind", ["opacities", "batch", "frozen", "bounded"])
def test_takes_the_steps_of_torch_operations(kind: str, launches: list[int]) -> None:
    """In float32 and in float64, of rows that are of two ages, reach the bounds, and have NaN at times."""
    field, generator = field_of(kind), torch.Generator().manual_seed(2)
    twin = copy.deepcopy(field).double()
    settings: dict[str, Any] = {"min_sigma": 2.0, "bounded": kind == "bounded"}
    optimizers = [GaussianAdam(each, 0.5, **settings) for each in (field, twin)]
    for step in range(4):
        for each, optimizer in zip((field, twin), optimizers, strict=True):
            if step == 1:
                optimizer.append(each, copy.deepcopy(each))
            if step == 2:
                rows_of_field = torch.arange(each.num_gaussians, device=DEVICE)
                optimizer.freeze(each, (rows_of_field == 5).expand(each.means.shape[:-1]))
        give_gradients(generator, field, twin)
        rows = [0, 7, 19] + [5] * (step >= 2)
        for each in (field, twin):
            assert each.means.grad is not None and each.colors.grad is not None
            each.means.grad[..., rows[0], 1] = math.nan
            each.colors.grad[..., rows[1], 2] = math.inf
            each.colors.grad[..., rows[2], 0] = -math.inf
        before = copy.deepcopy([*field.parameters()])
        for optimizer in optimizers:
            optimizer.step()
        for value, old in zip(field.parameters(), before, strict=True):
            stays = (value == old).all(-1) if value.ndim == field.means.ndim else value == old
            assert stays[..., rows].all() and bool(stays.all()) != value.requires_grad
    assert len(launches) == 4
    for value, expected in zip(field.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=2e-5, check_dtype=False)
    for value, expected in zip(*map(states, optimizers), strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6, check_dtype=False)


@pytest.mark.filterwarnings("ignore:overflow")  # numpy's, in the interpreter
def test_rates_that_overflow_leave_numbers_finite() -> None:
    field, generator = field_of("plain"), torch.Generator().manual_seed(2)
    optimizer = GaussianAdam(field, 1e38, color_lr=3e38)
    for _ in range(2):
        give_gradients(generator, field)
        optimizer.step()
    assert all(parameter.isfinite().all() for parameter in field.parameters())


def test_a_rate_on_the_device() -> None:
    """A captured graph reads it anew at each replay."""
    fields = [field_of("plain"), field_of("plain")]
    for field, rate in zip(fields, [0.25, torch.tensor(0.25, device=DEVICE)], strict=True):
        give_gradients(torch.Generator().manual_seed(2), field)
        GaussianAdam(field, rate).step()
    assert torch.equal(fields[0].means, fields[1].means)
