"""Pruning keeps its bound and removes what it can."""

from __future__ import annotations

import math

import pytest
import torch

from kcgs import GaussianField, Scene
from kcgs.pruning import prune


@pytest.fixture
def scene() -> Scene:
    field = GaussianField.random(300, (40, 60), seed=0)
    with torch.no_grad():
        field.colors[:100] *= torch.logspace(-6, 0, 100)[:, None]
    return Scene(field)


@pytest.mark.parametrize("tolerance", [0.0, 1e-4, 1e-2, 0.1])
def test_change_is_within_the_tolerance(scene: Scene, tolerance: float) -> None:
    result = prune(scene, tolerance=tolerance)
    with torch.no_grad():
        change = (scene() - result.scene()).abs().max()
    assert float(change) == result.change <= tolerance + 1e-6
    assert len(result.scene) == 300 - result.removed


def test_a_larger_tolerance_removes_more(scene: Scene) -> None:
    removed = [prune(scene, tolerance=t).removed for t in (0.0, 1e-3, 1e-1, 1e3)]
    assert removed == sorted(removed)
    assert removed[0] == 0 < removed[1] < removed[2] < removed[3] == 300


def test_what_paints_nothing_goes(scene: Scene) -> None:
    labels = torch.zeros(40, 60, dtype=torch.long)
    ids = torch.zeros(300, dtype=torch.long)
    ids[50:80] = 9
    field = scene.field
    confined = GaussianField(field.means, field.cholesky, field.colors, ids, size=(40, 60))
    result = prune(Scene(confined, labels), tolerance=0.0)
    assert (result.removed, result.change) == (30, 0.0)


def test_opacities_count(scene: Scene) -> None:
    opacities = torch.ones(300)
    opacities[:40] = 0
    field = scene.field
    faint = GaussianField(field.means, field.cholesky, field.colors, opacities=opacities, size=(40, 60))
    assert prune(Scene(faint), tolerance=0.0).removed == 40


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_without_a_graph(scene: Scene, mode: type) -> None:
    want = prune(scene, tolerance=1e-2)
    with mode():
        got = prune(scene, tolerance=1e-2)
    assert got[1:] == want[1:]


def test_nothing_to_prune() -> None:
    assert prune(Scene(GaussianField.random(0, (4, 4)))).removed == 0


@pytest.mark.parametrize("tolerance", [-1e-3, math.nan, math.inf])
def test_bad_tolerance(scene: Scene, tolerance: float) -> None:
    with pytest.raises(ValueError, match="tolerance must be"):
        prune(scene, tolerance=tolerance)
