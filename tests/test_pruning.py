"""Pruning keeps its bound and removes what it can."""

from __future__ import annotations

import math

import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene
from kcgs.pruning import prune
from tests.tester import BaseTester


@pytest.fixture
def scene() -> Scene:
    field = GaussianField.random(300, (40, 60), seed=0)
    with torch.no_grad():
        field.colors[:100] *= torch.logspace(-6, 0, 100)[:, None]
    return Scene(field)


class TestPrune(
    BaseTester,
    without={
        "test_gradcheck": "the result has no graph",
        "test_module": "a function; it returns a Scene",
        "test_dynamo": "it reads values; the scene that it returns compiles as any does",
    },
):
    def test_smoke(self, backend: str, device: torch.device, dtype: torch.dtype, scene: Scene) -> None:
        scene = scene.to(device, torch.promote_types(dtype, torch.float32))
        result = prune(scene, tolerance=1e-2, backend=backend)
        image = result.scene()
        assert 0 < result.num_pruned < 300 and 0 < result.prune_error <= 1e-2
        assert image.device.type == device.type and image.dtype == scene.field.colors.dtype and image.any()

    @pytest.mark.parametrize(("count", "channels"), [(0, 1), (1, 4), (20, 4)])
    def test_cardinality(self, device: torch.device, count: int, channels: int) -> None:
        scene = Scene(GaussianField.random(count, (9, 17), channels=channels, seed=0), metadata={"title": "few"})
        result = prune(scene.to(device), tolerance=0.1)
        assert result.scene.num_gaussians == count - result.num_pruned and result.scene.size == (9, 17)
        assert result.scene().shape == (channels, 9, 17) and result.scene.metadata == {"title": "few"}

    @pytest.mark.parametrize("tolerance", [0.0, 1e-2])
    def test_feature(self, scene: Scene, tolerance: float) -> None:
        result = prune(scene, tolerance=tolerance)
        with torch.no_grad():
            change = (scene() - result.scene()).abs().max()
        assert float(change) == result.prune_error <= tolerance + 1e-6
        assert result.scene.num_gaussians == 300 - result.num_pruned

    @pytest.mark.parametrize(("maps", "tolerance"), [(None, 1e-2), ("one", 0.0), ("each", 1e-2), ("each", 1e3)])
    def test_a_batch_is_as_each_image_alone(self, maps: str | None, tolerance: float) -> None:
        """Gaussians keep their row, and those that go have the colour 0."""
        labels = torch.stack([(torch.arange(60) >= x).long().expand(40, 60) for x in (20, 30, 40)])
        regions = {None: None, "one": RegionMap(labels[0], 0.7), "each": RegionMap(labels, [0.7, 0.0, 1.2])}[maps]
        own = [regions if regions is None or maps == "one" else regions[k] for k in range(3)]
        fields = [GaussianField.random(200, (40, 60), regions=one, seed=k) for k, one in enumerate(own)]
        for k, field in enumerate(fields):
            field.colors.data *= torch.logspace(-6 + k, 0, 200)[:, None]
        result = prune(Scene(GaussianField.stack(fields), regions, {"title": "three"}), tolerance)
        assert result.scene.metadata == {"title": "three"} and len(result.scene) == 3
        for k, (field, one) in enumerate(zip(fields, own, strict=True)):
            alone = prune(Scene(field, one), tolerance)
            stays = (result.scene.field.colors[k] != 0).any(-1)
            assert int(result.num_pruned[k]) == alone.num_pruned and float(result.prune_error[k]) == alone.prune_error
            assert torch.equal(result.scene.field.colors[k][stays], alone.scene.field.colors)
            assert torch.equal(result.scene.field.means[k], field.means)

    def test_a_larger_tolerance_removes_more(self, scene: Scene) -> None:
        counts = [prune(scene, tolerance=t).num_pruned for t in (0.0, 1e-3, 1e-1, 1e3)]
        assert counts == sorted(counts)
        assert counts[0] == 0 < counts[1] < counts[2] < counts[3] == 300

    def test_no_more_could_go(self) -> None:
        """Of Gaussians that do not overlap, all go whose colours are within the tolerance."""
        x, y = torch.meshgrid(torch.arange(6.5, 60, 12), torch.arange(6.5, 40, 12), indexing="ij")
        means, cholesky = torch.stack([x, y], -1).view(15, 2), torch.tensor([[0.7, 0.0, 0.7]]).expand(15, 3)
        field = GaussianField(means, cholesky, torch.linspace(0.001, 0.015, 15)[:, None], size=(40, 60))
        counts = [prune(Scene(field), tolerance=0.001 * k + 0.0005).num_pruned for k in range(16)]
        assert counts == [*range(16)]

    def test_gaussians_that_paint_nothing_go(self, scene: Scene) -> None:
        """Those of a region that the map does not have, and those of opacity 0."""
        labels, ids, opacities = torch.zeros(40, 60).long(), torch.zeros(300).long(), torch.ones(300)
        ids[50:80], opacities[:40] = 9, 0.0
        field = scene.field
        field = GaussianField(field.means, field.cholesky, field.colors, ids, opacities, size=(40, 60))
        result = prune(Scene(field, labels), tolerance=0.0)
        assert (result.num_pruned, result.prune_error) == (70, 0.0)

    @pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
    def test_without_a_graph(self, scene: Scene, mode: type) -> None:
        expected = prune(scene, tolerance=1e-2)
        with mode():
            result = prune(scene, tolerance=1e-2)
        assert result[1:] == expected[1:]

    @pytest.mark.parametrize("tolerance", [-1e-3, math.nan, math.inf])
    def test_exception(self, scene: Scene, tolerance: float) -> None:
        with pytest.raises(ValueError, match="tolerance must be"):
            prune(scene, tolerance=tolerance)
