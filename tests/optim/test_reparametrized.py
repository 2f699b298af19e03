"""ReparametrizedOptimizer: what a checkpoint stores."""

from __future__ import annotations

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
