"""Scenes to bytes and back."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene, fit
from kcgs.codec import decode, encode
from kcgs.codec.file import LAYER_CRC, unpack
from kcgs.functional import region_splat

from .conftest import GOLDEN, make_scene


def psnr_between(scene: Scene, other: Scene) -> float:
    """PSNR before clipping, without a cutoff."""
    renders = []
    for field in (scene.field, other.field):
        numbers = (t.detach().double() for t in (field.means, field.cholesky, field.merged_colors()))
        renders.append(region_splat(*numbers, field.region_ids, scene.regions, size=scene.size, cutoff=0.0))
    return -10 * math.log10(float((renders[0] - renders[1]).square().mean()))


def without_map(scene: Scene, **tensors: torch.Tensor) -> Scene:
    """The Gaussians of a scene without its map, with other tensors."""
    numbers = {name: getattr(scene.field, name) for name in ("means", "cholesky", "colors")} | tensors
    return Scene(GaussianField(**numbers, size=scene.size))


class TestEncode:
    @pytest.mark.parametrize(("regions", "channels"), [(1, 1), (2, 3), (5, 4)])
    def test_roundtrip(self, regions: int, channels: int) -> None:
        scene = make_scene(80, regions=regions, channels=channels)
        data = encode(scene, quality=40)
        assert data == encode(scene, quality=40)
        decoded = decode(data)
        assert decoded.layers == decoded.num_layers and decoded.scene.size == scene.size
        assert decoded.scene.field.colors.shape[-1] == channels
        if scene.regions is None:
            assert decoded.scene.regions is None and decoded.scene.field.region_ids is None
        else:
            assert decoded.scene.regions is not None
            assert torch.equal(decoded.scene.regions.labels, scene.regions.labels)
            assert decoded.scene.regions.softness == scene.regions.softness

    def test_gaussians_keep_their_regions(self, scene: Scene) -> None:
        def keys(field: GaussianField) -> set[tuple[int, ...]]:
            """Rounded centres and ids, since the order is the file's."""
            assert field.region_ids is not None
            rows = field.means.detach().round().int().tolist()
            return {(*row, int(region)) for row, region in zip(rows, field.region_ids, strict=True)}

        decoded = decode(encode(scene, quality=70)).scene
        assert len(keys(decoded.field) & keys(scene.field)) > 0.7 * scene.num_gaussians

    def test_opacities_are_merged(self) -> None:
        scene = make_scene(regions=1)
        translucent = without_map(scene, opacities=torch.full((60,), 0.5))
        assert encode(translucent) == encode(without_map(scene, colors=0.5 * scene.field.colors.detach()))

    def test_a_map_of_one_region_is_not_kept(self) -> None:
        scene = make_scene(regions=1)
        confined = without_map(scene, region_ids=torch.full((60,), 9)).field
        assert encode(Scene(confined, torch.full((24, 36), 9))) == encode(scene)

    @pytest.mark.parametrize(("visible", "count"), [(10, 10), (0, 1)])
    def test_black_gaussians_are_left_out(self, visible: int, count: int) -> None:
        scene = make_scene(regions=1)
        colors = scene.field.colors.detach().clone()
        colors[visible:] = 1e-7
        decoded = decode(encode(without_map(scene, colors=colors))).scene
        assert decoded.num_gaussians <= count and bool(decoded.render().any()) == bool(visible)

    @pytest.mark.parametrize("labels", [None, (torch.arange(48) >= 24).long().expand(32, 48)])
    def test_a_scene_without_gaussians_is_black(self, labels: torch.Tensor | None) -> None:
        scene = fit(torch.zeros(3, 32, 48), labels, num_gaussians=20, iterations=5).scene
        assert scene.num_gaussians == 0
        for data in (encode(scene), encode(scene, target_bytes=300)):
            assert torch.equal(decode(data).scene.render(), scene.render())

    @pytest.mark.parametrize("size", [(1, 1), (1, 300)])
    def test_tiny_images(self, size: tuple[int, int]) -> None:
        assert decode(encode(Scene(GaussianField.random(5, size, seed=0)), quality=60)).scene.size == size

    def test_extreme_gaussians(self) -> None:
        means = torch.tensor([[5.0, 5.0], [-4000.0, 9.0], [8.0, 8.0], [1.0, 1.0]])
        cholesky = torch.tensor([[0.1, 0.0, 0.1], [30.0, 0.0, 9000.0], [0.1, 40.0, 0.1], [50.0, 0.0, 50.0]])
        colors = torch.tensor([[1e-3, 0.0, 0.0], [2.0, 2.0, 2.0], [9.0, -9.0, 0.0], [1e4, 1e4, 1e4]])
        field = decode(encode(Scene(GaussianField(means, cholesky, colors, size=(20, 20))), quality=60)).scene.field
        assert torch.isfinite(field.means).all() and (field.cholesky[:, ::2] > 0).all()

    def test_many_equal_gaussians(self) -> None:
        """All bits that distinguish them are zeros, which streams leave out at their end."""
        cholesky = torch.tensor([[1.0, 0.0, 1.0]]).repeat(3000, 1)
        field = GaussianField(torch.full((3000, 2), 0.5), cholesky, torch.ones(3000, 1), size=(1, 1))
        assert decode(encode(Scene(field), quality=10)).scene.num_gaussians == 3000

    def test_absent_energies(self) -> None:
        means = torch.rand(60, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([36, 24])
        strengths = torch.tensor([4e3, 3e2, *[0.5] * 58])
        cholesky = torch.tensor([[3.0, 0.5, 2.0]]).expand(60, -1)
        field = GaussianField(means, cholesky, strengths[:, None].expand(-1, 3), size=(24, 36))
        decoded = decode(encode(Scene(field), quality=70))
        assert decoded.num_layers == 1  # two strong ones are too few for a layer
        colors = decoded.scene.field.colors.amax(1).sort(descending=True).values
        assert torch.allclose(colors, strengths, rtol=0.02)

    @pytest.mark.parametrize("quality", [30.0, 60.0])
    def test_quality(self, quality: float) -> None:
        scene = make_scene(400, (96, 144), regions=1)
        # errors outside the image do not count, but the quantizer assumes whole Gaussians
        assert quality - 1.0 < psnr_between(scene, decode(encode(scene, quality=quality)).scene) < quality + 6.0

    def test_target_bytes(self) -> None:
        assert 870 < len(encode(make_scene(300, (96, 144)), target_bytes=900)) <= 900

    @pytest.mark.parametrize(
        ("call", "match"),
        [
            (lambda scene: encode(None), "scene must be a Scene"),
            (lambda scene: encode(scene, quality=5), "quality must be in"),
            (lambda scene: encode(scene, quality=True), "quality must be a number"),
            (lambda scene: encode(scene, quality=40, target_bytes=9), "quality must be None with target_bytes; got 40"),
            (lambda scene: encode(scene, target_bytes=1.5), "target_bytes must be an integer"),
            (lambda scene: encode(scene, target_bytes=20), "target_bytes must be at least [0-9]+ for this scene"),
            (lambda scene: encode(Scene(scene.field, scene.regions.resize((9, 9)))), "regions must have the size"),
            (lambda scene: encode(Scene(scene.field, torch.eye(24, 36).long())), "region_ids must be ids of the map"),
            (lambda scene: encode(without_map(scene, colors=torch.full((60, 3), 1e12))), "colors must be below"),
            (
                lambda scene: encode(Scene(GaussianField.random(5, (1, (1 << 20) + 1), seed=0))),
                "pixels per side must be in .1, 1048576.; got 1048577",
            ),
            (
                lambda scene: encode(without_map(scene, colors=torch.ones(60, 1025))),
                "channels must be in .1, 1024.; got 1025",
            ),
        ],
    )
    def test_wrong_arguments(self, scene: Scene, call: Callable[[Any], Any], match: str) -> None:
        with pytest.raises((TypeError, ValueError), match=match):
            call(scene)

    @pytest.mark.parametrize(
        ("name", "value", "match"),
        [
            ("means", math.nan, "means must be finite"),
            ("cholesky", -1.0, "cholesky must have l11 > 0"),
            ("colors", math.inf, "colors must be finite"),
        ],
    )
    def test_values_that_became_invalid(self, scene: Scene, name: str, value: float, match: str) -> None:
        with torch.no_grad():
            getattr(scene.field, name)[3, 0] = value
        with pytest.raises(ValueError, match=match):
            encode(scene)

    def test_resized_maps(self, scene: Scene) -> None:
        regions = RegionMap(scene.regions.labels, 0.5).resize((12, 18))
        field = GaussianField.random(9, (12, 18), regions=regions.labels, seed=0)
        with pytest.raises(ValueError, match="regions must be a map of its own pixels"):
            encode(Scene(field, regions))


class TestDecode:
    def test_same_bits_on_all_machines(self) -> None:
        decoded = decode(GOLDEN.read_bytes())
        assert (decoded.num_layers, decoded.scene.num_gaussians) == (5, 300)
        field, regions = decoded.scene.field, decoded.scene.regions
        assert regions is not None and field.region_ids is not None
        tensors = (field.means, field.cholesky, field.colors, field.region_ids, regions.labels)
        bits = b"".join(t.detach().numpy().tobytes() for t in tensors)
        assert hashlib.sha256(bits).hexdigest()[:16] == "031047e39cffb0c0"

    def test_parts_are_coarser_images(self) -> None:
        scene = make_scene(800, (96, 144))
        data = encode(scene)
        psnrs = [psnr_between(scene, decode(data, max_bytes=len(data) * share // 10).scene) for share in (3, 5, 8, 10)]
        assert psnrs == sorted(psnrs) and psnrs[-1] > psnrs[0] + 10

    def test_no_layer_holds_few_gaussians(self) -> None:
        data = encode(make_scene(800, (96, 128)), quality=40)
        layers = [length + LAYER_CRC for _, length in unpack(data)[0].layers]
        ends = itertools.accumulate(layers, initial=len(data) - sum(layers))
        counts = [0, *(decode(data[:end]).scene.num_gaussians for end in [*ends][1:])]
        sizes = [last - first for first, last in itertools.pairwise(counts)]
        assert len(sizes) > 3 and min(sizes) >= max(100, counts[-1] / 16)
        assert decode(encode(make_scene(190, (96, 128)))).num_layers == 1

    @pytest.mark.parametrize(
        ("arguments", "match"),
        [(("x",), "data must be bytes; got str"), ((b"x", 0), "max_bytes must be at least 1")],
    )
    def test_wrong_arguments(self, arguments: tuple[Any, ...], match: str) -> None:
        with pytest.raises((TypeError, ValueError), match=match):
            decode(arguments[0], max_bytes=arguments[1] if arguments[1:] else None)
