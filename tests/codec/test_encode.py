"""Scenes to bytes and back: bits, sizes, goals, refusals."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import pytest
import torch

from kcgs import GaussianField, RegionMap, load
from kcgs.codec import decode, encode
from kcgs.functional import region_splat
from kcgs.nn.renderer import render_image

from .conftest import make_scene

Scene = tuple[GaussianField, RegionMap]


def picture(field: GaussianField, regions: RegionMap | None) -> torch.Tensor:
    tensors = (t.detach().double() for t in (field.means, field.cholesky, field.merged_colors()))
    means, cholesky, colors = tensors
    return region_splat(means, cholesky, colors, field.region_ids, regions, size=field.size, cutoff=0.0)


def psnr_between(one: GaussianField, other: GaussianField, regions: RegionMap | None) -> float:
    error = (picture(one, regions) - picture(other, regions)).square().mean()
    return -10 * math.log10(float(error))


class TestRoundTrip:
    @pytest.mark.parametrize("regions", [1, 2, 5])
    @pytest.mark.parametrize("channels", [1, 3, 4])
    def test_what_is_decoded_encodes_to_itself(self, regions: int, channels: int) -> None:
        field, map_ = make_scene(80, regions=regions, channels=channels)
        first = decode(encode(field, map_, quality=40))
        assert first.layers == first.num_layers and first.field.size == field.size
        assert first.field.colors.shape[-1] == channels
        if map_ is None:
            assert first.regions is None and first.field.region_ids is None
        else:
            assert first.regions is not None and torch.equal(first.regions.labels, map_.labels)
            assert first.regions.softness == map_.softness

    def test_gaussians_keep_their_regions(self, scene: Scene) -> None:
        field, regions = scene
        found = decode(encode(field, regions, quality=70)).field
        assert found.region_ids is not None and field.region_ids is not None

        # as a multiset of (rounded centre, id): the order is the file's
        def keys(f: GaussianField) -> set[tuple[int, ...]]:
            assert f.region_ids is not None
            return {
                (*row.tolist(), int(i)) for row, i in zip(f.means.detach().round().int(), f.region_ids, strict=True)
            }

        assert len(keys(found) & keys(field)) > 0.7 * len(field)

    def test_same_bytes_each_time(self, scene: Scene) -> None:
        assert encode(*scene) == encode(*scene)

    def test_same_bits_everywhere(self) -> None:
        found = decode((Path(__file__).parent / "golden.kcgs").read_bytes())
        field, regions = found.field, found.regions
        assert regions is not None and field.region_ids is not None
        tensors = (field.means, field.cholesky, field.colors, field.region_ids, regions.labels)
        bits = b"".join(t.detach().numpy().tobytes() for t in tensors)
        assert hashlib.sha256(bits).hexdigest()[:16] == "51255d36c798f4b7"

    def test_sub_pixel_map(self) -> None:
        field, _ = make_scene(regions=1)
        fine = (torch.arange(72) > 31).long().expand(48, 72)
        regions = RegionMap.from_labels(fine, supersample=2)
        field = GaussianField(field.means, field.cholesky, field.colors, torch.arange(60) % 2, size=field.size)
        found = decode(encode(field, regions)).regions
        assert found is not None and found.supersample == 2
        assert found.fine_labels is not None and torch.equal(found.fine_labels, fine)

    def test_opacities_are_merged(self) -> None:
        field, _ = make_scene(regions=1)
        seen = GaussianField(
            field.means, field.cholesky, field.colors, opacities=torch.full((60,), 0.5), size=field.size
        )
        halves = GaussianField(field.means, field.cholesky, 0.5 * field.colors.detach(), size=field.size)
        assert encode(seen) == encode(halves)

    def test_one_region_takes_one_byte(self) -> None:
        field, _ = make_scene(regions=1)
        whole = RegionMap.from_labels(torch.full((24, 36), 9))
        with_ids = GaussianField(field.means, field.cholesky, field.colors, torch.full((60,), 9), size=field.size)
        assert encode(with_ids, whole) == encode(field)

    def test_black_ones_are_left_out(self) -> None:
        field, _ = make_scene(regions=1)
        colors = field.colors.detach().clone()
        colors[10:] = 1e-7
        found = decode(encode(GaussianField(field.means, field.cholesky, colors, size=field.size)))
        assert len(found.field) <= 10

    def test_nothing_but_black(self) -> None:
        field, _ = make_scene(regions=1)
        black = GaussianField(field.means, field.cholesky, torch.zeros(60, 3), size=field.size)
        found = decode(encode(black))
        assert len(found.field) == 1 and not render_image(found.field, None).any()

    @pytest.mark.parametrize("size", [(1, 1), (1, 300), (3, 5)])
    def test_tiny_pictures(self, size: tuple[int, int]) -> None:
        field = GaussianField.random(5, size, seed=0)
        assert decode(encode(field, quality=60)).field.size == size

    def test_extreme_gaussians(self) -> None:
        means = torch.tensor([[5.0, 5.0], [-4000.0, 9.0], [8.0, 8.0], [1.0, 1.0]])
        cholesky = torch.tensor([[0.1, 0.0, 0.1], [30.0, 0.0, 9000.0], [0.1, 40.0, 0.1], [50.0, 0.0, 50.0]])
        colors = torch.tensor([[1e-3, 0.0, 0.0], [2.0, 2.0, 2.0], [9.0, -9.0, 0.0], [1e4, 1e4, 1e4]])
        found = decode(encode(GaussianField(means, cholesky, colors, size=(20, 20)), quality=60)).field
        assert torch.isfinite(found.means).all() and (found.cholesky[:, ::2] > 0).all()

    def test_many_of_one_kind_in_one_place(self) -> None:
        # all bits that tell them apart are zeros, which files leave out at their end
        many = GaussianField(
            torch.full((3000, 2), 0.5),
            torch.tensor([[1.0, 0.0, 1.0]]).repeat(3000, 1),
            torch.ones(3000, 1),
            size=(1, 1),
        )
        assert len(decode(encode(many, quality=10)).field) == 3000


class TestGoals:
    @pytest.mark.parametrize("quality", [30.0, 45.0, 60.0])
    def test_quality(self, quality: float) -> None:
        field, regions = make_scene(400, (96, 144), regions=1)
        found = decode(encode(field, regions, quality=quality)).field
        # Gaussians that leave the image add less than the whole ones that are reckoned with
        assert quality - 1.0 < psnr_between(field, found, None) < quality + 6.0

    def test_target(self) -> None:
        field, regions = make_scene(300, (96, 144))
        sizes = [len(encode(field, regions, target_bytes=target)) for target in (900, 1500, 2500)]
        assert all(0.97 * target < size <= target for size, target in zip(sizes, (900, 1500, 2500), strict=True))

    def test_target_that_cannot_be(self, scene: Scene) -> None:
        with pytest.raises(ValueError, match="target_bytes must be at least [0-9]+ for this scene; got 20"):
            encode(*scene, target_bytes=20)

    def test_half_of_the_file_is_most_of_the_picture(self) -> None:
        field, regions = make_scene(400, (96, 144))
        data = encode(field, regions)
        psnrs = [
            -10 * math.log10(float((picture(part.field, regions) - picture(field, regions)).square().mean()))
            for part in (decode(data, max_bytes=len(data) * share // 10) for share in (3, 5, 8, 10))
        ]
        assert psnrs == sorted(psnrs) and psnrs[-1] > psnrs[0] + 10


class TestRefusals:
    def test_arguments(self, scene: Scene) -> None:
        field, regions = scene
        for call, match in (
            (lambda: encode(None), "field must be a GaussianField"),  # type: ignore[arg-type]
            (lambda: encode(field, "x"), "regions must be a RegionMap"),  # type: ignore[arg-type]
            (lambda: encode(field, regions, quality=5), "quality must be in"),
            (lambda: encode(field, regions, quality=True), "quality must be a number"),
            (lambda: encode(field, regions, quality=40, target_bytes=900), "exclude each other"),
            (lambda: encode(field, regions, target_bytes=1.5), "target_bytes must be an integer"),  # type: ignore[arg-type]
            (lambda: encode(field, regions.resize((9, 9))), "regions must be one map of size"),
            (lambda: encode(field, torch.zeros(24, 36).long() + torch.arange(36) // 18), "region_ids must be ids"),
            (lambda: encode(field.subset(slice(0, 0))), "must"),
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
        field, regions = scene
        with torch.no_grad():
            getattr(field, name)[3, 0] = value
        with pytest.raises(ValueError, match=match):
            encode(field, regions)

    def test_what_no_decoder_takes(self) -> None:
        wide = GaussianField.random(5, (1, (1 << 20) + 1), seed=0)
        with pytest.raises(ValueError, match="size must be at most 1048576 pixels per side"):
            encode(wide)
        field, _ = make_scene(regions=1)
        deep = GaussianField(field.means, field.cholesky, torch.ones(60, 1025), size=field.size)
        with pytest.raises(ValueError, match="colors must have at most 1024 channels; got 1025"):
            encode(deep)
        ids = torch.zeros(60, dtype=torch.long)
        fine = RegionMap.from_labels((torch.arange(65 * 24) >= 99).long()[:, None].expand(-1, 65 * 36), supersample=65)
        with pytest.raises(ValueError, match="supersample must be at most 64; got 65"):
            encode(GaussianField(field.means, field.cholesky, field.colors, ids, size=field.size), fine)

    def test_load_reads_it(self, scene: Scene, tmp_path: object) -> None:
        path = f"{tmp_path}/scene.kcgs"
        data = encode(*scene)
        with open(path, "wb") as file:
            file.write(data)
        assert torch.equal(load(path).field.means, decode(data).field.means)
        with open(path, "wb") as file:
            file.write(data[:-20])
        with pytest.raises(ValueError, match=r"cannot load .*scene.kcgs: it ends early"):
            load(path)
