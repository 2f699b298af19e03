"""Scenes to bytes and back: bits, sizes, goals, refusals."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import pytest
import torch

from kcgs import GaussianField, Scene, fit, load
from kcgs.codec import decode, encode
from kcgs.functional import region_splat

from .conftest import make_scene


def exact_render(scene: Scene) -> torch.Tensor:
    field = scene.field
    means, cholesky, colors = (t.detach().double() for t in (field.means, field.cholesky, field.merged_colors()))
    return region_splat(means, cholesky, colors, field.region_ids, scene.regions, size=scene.size, cutoff=0.0)


def psnr_between(one: Scene, other: Scene) -> float:
    return -10 * math.log10(float((exact_render(one) - exact_render(other)).square().mean()))


def changed(scene: Scene, **tensors: torch.Tensor) -> Scene:
    """Return the Gaussians of a scene without its map, with other tensors."""
    given = {name: getattr(scene.field, name) for name in ("means", "cholesky", "colors")} | tensors
    return Scene(GaussianField(**given, size=scene.size))


class TestRoundTrip:
    @pytest.mark.parametrize("regions", [1, 2, 5])
    @pytest.mark.parametrize("channels", [1, 3, 4])
    def test_what_is_decoded_encodes_to_itself(self, regions: int, channels: int) -> None:
        scene = make_scene(80, regions=regions, channels=channels)
        first = decode(encode(scene, quality=40))
        found = first.scene
        assert first.layers == first.num_layers and found.size == scene.size
        assert found.field.colors.shape[-1] == channels
        if scene.regions is None:
            assert found.regions is None and found.field.region_ids is None
        else:
            assert found.regions is not None and torch.equal(found.regions.labels, scene.regions.labels)
            assert found.regions.softness == scene.regions.softness

    def test_gaussians_keep_their_regions(self, scene: Scene) -> None:
        found = decode(encode(scene, quality=70)).scene.field

        # as a multiset of (rounded centre, id): the order is the file's
        def keys(f: GaussianField) -> set[tuple[int, ...]]:
            assert f.region_ids is not None
            return {
                (*row.tolist(), int(i)) for row, i in zip(f.means.detach().round().int(), f.region_ids, strict=True)
            }

        assert len(keys(found) & keys(scene.field)) > 0.7 * scene.num_gaussians

    def test_same_bytes_each_time(self, scene: Scene) -> None:
        assert encode(scene) == encode(scene)

    def test_same_bits_everywhere(self) -> None:
        found = decode((Path(__file__).parent / "golden.kcgs").read_bytes()).scene
        field, regions = found.field, found.regions
        assert regions is not None and field.region_ids is not None
        tensors = (field.means, field.cholesky, field.colors, field.region_ids, regions.labels)
        bits = b"".join(t.detach().numpy().tobytes() for t in tensors)
        assert hashlib.sha256(bits).hexdigest()[:16] == "031047e39cffb0c0"

    def test_opacities_are_merged(self) -> None:
        scene = make_scene(regions=1)
        faded = changed(scene, opacities=torch.full((60,), 0.5))
        assert encode(faded) == encode(changed(scene, colors=0.5 * scene.field.colors.detach()))

    def test_one_region_takes_one_byte(self) -> None:
        scene = make_scene(regions=1)
        confined = changed(scene, region_ids=torch.full((60,), 9)).field
        assert encode(Scene(confined, torch.full((24, 36), 9))) == encode(scene)

    def test_black_ones_are_left_out(self) -> None:
        scene = make_scene(regions=1)
        colors = scene.field.colors.detach().clone()
        colors[10:] = 1e-7
        assert decode(encode(changed(scene, colors=colors))).scene.num_gaussians <= 10

    def test_nothing_but_black(self) -> None:
        found = decode(encode(changed(make_scene(regions=1), colors=torch.zeros(60, 3)))).scene
        assert found.num_gaussians == 1 and not found.render().any()

    @pytest.mark.parametrize("size", [(1, 1), (1, 300), (3, 5)])
    def test_tiny_images(self, size: tuple[int, int]) -> None:
        scene = Scene(GaussianField.random(5, size, seed=0))
        assert decode(encode(scene, quality=60)).scene.size == size

    def test_extreme_gaussians(self) -> None:
        means = torch.tensor([[5.0, 5.0], [-4000.0, 9.0], [8.0, 8.0], [1.0, 1.0]])
        cholesky = torch.tensor([[0.1, 0.0, 0.1], [30.0, 0.0, 9000.0], [0.1, 40.0, 0.1], [50.0, 0.0, 50.0]])
        colors = torch.tensor([[1e-3, 0.0, 0.0], [2.0, 2.0, 2.0], [9.0, -9.0, 0.0], [1e4, 1e4, 1e4]])
        found = decode(encode(Scene(GaussianField(means, cholesky, colors, size=(20, 20))), quality=60)).scene.field
        assert torch.isfinite(found.means).all() and (found.cholesky[:, ::2] > 0).all()

    def test_many_of_one_kind_in_one_place(self) -> None:
        # all bits that tell them apart are zeros, which files leave out at their end
        many = GaussianField(
            torch.full((3000, 2), 0.5),
            torch.tensor([[1.0, 0.0, 1.0]]).repeat(3000, 1),
            torch.ones(3000, 1),
            size=(1, 1),
        )
        assert decode(encode(Scene(many), quality=10)).scene.num_gaussians == 3000


class TestGoals:
    @pytest.mark.parametrize("quality", [30.0, 45.0, 60.0])
    def test_quality(self, quality: float) -> None:
        scene = make_scene(400, (96, 144), regions=1)
        found = decode(encode(scene, quality=quality)).scene
        # Gaussians that leave the image add less than the whole ones that are reckoned with
        assert quality - 1.0 < psnr_between(scene, found) < quality + 6.0

    def test_target(self) -> None:
        scene = make_scene(300, (96, 144))
        sizes = [len(encode(scene, target_bytes=target)) for target in (900, 1500, 2500)]
        assert all(0.97 * target < size <= target for size, target in zip(sizes, (900, 1500, 2500), strict=True))

    def test_target_that_cannot_be(self, scene: Scene) -> None:
        with pytest.raises(ValueError, match="target_bytes must be at least [0-9]+ for this scene; got 20"):
            encode(scene, target_bytes=20)

    def test_half_of_the_file_is_most_of_the_image(self) -> None:
        scene = make_scene(400, (96, 144))
        data = encode(scene)
        parts = [decode(data, max_bytes=len(data) * share // 10).scene for share in (3, 5, 8, 10)]
        psnrs = [psnr_between(Scene(part.field, scene.regions), scene) for part in parts]
        assert psnrs == sorted(psnrs) and psnrs[-1] > psnrs[0] + 10


class TestRefusals:
    def test_arguments(self, scene: Scene) -> None:
        field, regions = scene.field, scene.regions
        other = Scene(field, torch.zeros(24, 36).long() + torch.arange(36) // 18)
        for call, match in (
            (lambda: encode(None), "scene must be a Scene"),
            (lambda: encode(scene, quality=5), "quality must be in"),
            (lambda: encode(scene, quality=True), "quality must be a number"),
            (lambda: encode(scene, quality=40, target_bytes=900), "quality must be None with target_bytes; got 40"),
            (lambda: encode(scene, target_bytes=1.5), "target_bytes must be an integer"),
            (lambda: encode(Scene(field, regions.resize((9, 9)))), "regions must have the size"),
            (lambda: encode(other), "region_ids must be ids"),
            (lambda: encode(Scene(field.subset(slice(0, 0)))), "must"),
            (lambda: decode("x"), "data must be bytes"),  # type: ignore[arg-type]
            (lambda: decode(b"x", max_bytes=0), "max_bytes must be at least 1"),
        ):
            with pytest.raises((TypeError, ValueError), match=match):
                call()

    @pytest.mark.parametrize(
        ("name", "value", "match"),
        [
            ("means", math.nan, "means must be finite"),
            ("cholesky", math.inf, "cholesky must be finite"),
            ("cholesky", -1.0, "cholesky must have l11 > 0"),
            ("colors", math.inf, "colors must be finite"),
        ],
    )
    def test_values_that_were_changed(self, scene: Scene, name: str, value: float, match: str) -> None:
        with torch.no_grad():
            getattr(scene.field, name)[3, 0] = value
        with pytest.raises(ValueError, match=match):
            encode(scene)

    def test_what_no_decoder_takes(self) -> None:
        wide = Scene(GaussianField.random(5, (1, (1 << 20) + 1), seed=0))
        with pytest.raises(ValueError, match="pixels per side must be in .1, 1048576.; got 1048577"):
            encode(wide)
        scene = make_scene(regions=1)
        with pytest.raises(ValueError, match="channels must be in .1, 1024.; got 1025"):
            encode(changed(scene, colors=torch.ones(60, 1025)))

    def test_load_reads_it(self, scene: Scene, tmp_path: object) -> None:
        path = f"{tmp_path}/scene.kcgs"
        data = encode(scene)
        with open(path, "wb") as file:
            file.write(data)
        assert torch.equal(load(path).field.means, decode(data).scene.field.means)
        with open(path, "wb") as file:
            file.write(data[:-20])
        with pytest.raises(ValueError, match=r"cannot load .*scene.kcgs: it ends early"):
            load(path)


@pytest.mark.parametrize("labels", [None, (torch.arange(48) >= 24).long().expand(32, 48)])
def test_a_scene_without_gaussians_is_black(labels: torch.Tensor | None) -> None:
    scene = fit(torch.zeros(3, 32, 48), labels, num_gaussians=20, iterations=5).scene
    assert scene.num_gaussians == 0
    for data in (encode(scene), encode(scene, target_bytes=300)):
        assert torch.equal(decode(data).scene.render(), scene.render())
