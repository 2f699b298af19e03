"""Gaussians by a renderer: sums over pixels, by the weights of each Gaussian."""

from __future__ import annotations

import pytest
import torch

from kcgs import GaussianField, RegionMap
from kcgs.optim.gaussians import Gaussians, Renderer

SIZE = (24, 40)


@pytest.mark.parametrize("regions", [None, RegionMap((torch.arange(40) >= 18).long().expand(SIZE), 0.8)])
def test_weight_sums_are_those_of_rendered_gaussians(regions: RegionMap | None) -> None:
    fields = [GaussianField.random(30, SIZE, regions=regions, seed=seed) for seed in range(2)]
    renderer = Renderer(SIZE, regions, 1e-6)
    total_of_batch, sums_of_batch = renderer.weight_sums(Gaussians.of(GaussianField.stack(fields)))
    planes = torch.rand(2, 1, *SIZE, generator=torch.Generator().manual_seed(0))
    for gaussians, plane, in_batch in zip(map(Gaussians.of, fields), planes, range(2), strict=True):
        weights = renderer.render(gaussians._replace(colors=torch.eye(30)))
        total, sums = renderer.weight_sums(gaussians)
        torch.testing.assert_close(total[0], weights.sum(0), atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(sums(plane), (weights * plane).sum((1, 2)), atol=1e-2, rtol=1e-3)
        torch.testing.assert_close(total_of_batch[in_batch], total, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(sums_of_batch(planes)[in_batch], sums(plane), atol=1e-3, rtol=1e-4)
