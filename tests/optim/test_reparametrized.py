"""ReparametrizedOptimizer: what a checkpoint stores, and the fields that it takes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField
from kcgs.optim import ReparametrizedOptimizer


class PlainOptimizer(ReparametrizedOptimizer):
    """Moves the numbers of the field as they are."""

    def encode(self, field: GaussianField) -> list[Tensor]:
        return [field.means, field.cholesky, field.colors]

    def decode(self) -> tuple[Tensor, Tensor, Tensor]:
        means, cholesky, colors = self.parameters
        return means, cholesky, colors


def make(field: GaussianField) -> PlainOptimizer:
    return PlainOptimizer(field, [0.1, 0.01, 0.01], torch.optim.Adam)


def test_frozen_rows_stay_frozen_in_a_state() -> None:
    field, twin = (GaussianField.random(5, (16, 24), seed=0) for _ in range(2))
    optimizer, resumed = make(field), make(twin)
    mask = torch.arange(5) < 2
    optimizer.freeze(field, mask)
    resumed.load_state_dict(optimizer.state_dict())
    assert torch.equal(resumed.frozen_rows(twin), mask)
    before = twin.means.detach().clone()
    for table in (twin.means, twin.cholesky, twin.colors):
        table.grad = torch.ones_like(table)
    resumed.step()
    assert torch.equal((twin.means != before).any(-1), ~mask)


ALL = torch.ones(5, dtype=torch.bool)


def field_of(channels: int = 3) -> GaussianField:
    return GaussianField.random(5, (16, 24), channels=channels, seed=0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *(
            (change, "field must be the one that the optimizer was made for; got another")
            for change in (
                lambda optimizer, _: optimizer.append(field_of(), field_of()),
                lambda optimizer, _: optimizer.keep(field_of(), ALL),
                lambda optimizer, _: optimizer.freeze(field_of(), ALL),
                lambda optimizer, _: optimizer.frozen_rows(field_of()),
            )
        ),
        (lambda optimizer, field: optimizer.append(field, field_of(1)), r"added must have colors \(N, 3\); got .*N, 1"),
        (lambda optimizer, field: optimizer.keep(field, ALL[:3]), r"mask must be boolean, \(5,\); got torch"),
    ],
)
def test_bad_rows_leave_the_field(change: Callable[[PlainOptimizer, GaussianField], object], words: str) -> None:
    field = field_of()
    with pytest.raises(ValueError, match=words):
        change(make(field), field)
    assert field.num_gaussians == 5


def test_keep_takes_a_mask_for_all_images_of_a_batch() -> None:
    batch = GaussianField.stack([GaussianField.random(5, (16, 24), seed=k) for k in range(2)])
    expected, mask = batch.means.detach()[:, 1:4], torch.tensor([False, True, True, True, False])
    optimizer = make(batch)
    optimizer.keep(batch, mask)
    assert torch.equal(batch.means.detach(), expected)
