"""The order of Gaussians by what they add to a render."""

from __future__ import annotations

import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene, fit
from kcgs.fitting import rank_gaussians
from kcgs.functional import psnr
from kcgs.nn import reorder_rows

from .test_batch import photos


def psnr_of_first(field: GaussianField, count: int) -> float:
    part = GaussianField(field.means[:, :count], field.cholesky[:, :count], field.colors[:, :count], size=field.size)
    return float(psnr(Scene(part).render(), photos()).mean())


def test_the_first_half_shows_the_image_better_than_any_half() -> None:
    field = fit(photos(), None, 60, iterations=100).scene.field
    ranked = reorder_rows(field, rank_gaussians(field))
    energy = field.colors.square().sum(-1) * field.cholesky[..., ::2].prod(-1)
    by_energy = reorder_rows(field, energy.argsort(descending=True))
    generator = torch.Generator().manual_seed(0)
    random = reorder_rows(field, torch.rand(3, 60, generator=generator).argsort())
    assert psnr_of_first(ranked, 30) > max(psnr_of_first(by_energy, 30), psnr_of_first(random, 30) + 6)
    assert psnr_of_first(ranked, 60) == pytest.approx(psnr_of_first(field, 60), abs=1e-3)


@pytest.mark.parametrize("has_maps", [False, True])
def test_a_batch_is_as_each_image_alone(has_maps: bool) -> None:
    maps = RegionMap(torch.stack([(torch.arange(56) > x).long().expand(40, 56) for x in (9, 20, 30)]))
    field = fit(photos(), maps if has_maps else None, 20, iterations=10, move_contours=False).scene.field
    order = rank_gaussians(field, maps if has_maps else None)
    for k in range(3):
        alone = rank_gaussians(field[k], maps[k] if has_maps else None)
        assert torch.equal(order[k], alone) and sorted(alone.tolist()) == list(range(20))


def test_opacities_count() -> None:
    field = GaussianField.random(20, (16, 24), seed=0)
    alpha = torch.linspace(0.1, 1.0, 20)
    faint = GaussianField(field.means, field.cholesky, field.colors, opacities=alpha, size=field.size)
    assert torch.equal(rank_gaussians(faint), rank_gaussians(faint.without_opacities()))
