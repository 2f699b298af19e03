"""Sums over pixels, by the weights of each Gaussian."""

from __future__ import annotations

import pytest
import torch

from kcgs import GaussianField, RegionMap
from kcgs.functional import region_splat
from kcgs.functional.weights import inner_products

SIZE = (24, 40)


@pytest.mark.parametrize("softness", [None, 0.8])
@pytest.mark.parametrize("backend", ["cpu", "tiled"])
def test_inner_products_are_those_of_rendered_gaussians(backend: str, softness: float | None) -> None:
    labels = (torch.arange(40) >= 18).long().expand(SIZE).contiguous()
    regions = None if softness is None else RegionMap.from_labels(labels, softness)
    field = GaussianField.random(30, SIZE, regions=regions, seed=0)
    means, cholesky, colors = (table.detach() for table in (field.means, field.cholesky, field.colors))
    ids = field.region_ids
    # a channel for each Gaussian alone
    weights = region_splat(means, cholesky, torch.eye(30), ids, regions, size=SIZE, cutoff=0, backend="reference")
    expected = (weights.flatten(1) @ weights.flatten(1).T) @ colors
    actual = inner_products(means, cholesky, colors, ids, regions, size=SIZE, cutoff=1e-6, backend=backend)
    torch.testing.assert_close(actual, expected, atol=1e-3, rtol=1e-4)
