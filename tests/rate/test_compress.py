"""Rounding with an eye on the image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene
from kcgs.codec import decode, encode
from kcgs.codec.gaussians.quantize import Quantizer
from kcgs.codec.scenes import SceneWriter
from kcgs.rate import compress, quality_for
from kcgs.rate.bits import soft_bits
from kcgs.rate.tuning import Tuning

from .conftest import Photo, psnr


class TestCompress:
    def test_less_error_at_the_same_bytes(self, photo: Photo, fitted: Scene) -> None:
        image, target = photo[0], 1300
        plain = encode(fitted, target_bytes=target)
        tuned = compress(fitted, image, target_bytes=target)
        for data in (plain, tuned.data):
            assert 0.97 * target < len(data) <= target
        assert psnr(decode(plain).scene, image) + 0.1 < psnr(tuned.scene, image)

    @pytest.mark.parametrize(("target", "most"), [(700, 2), (1300, 1)])
    def test_one_rounding_fills_the_bytes(self, photo: Photo, fitted: Scene, target: int, most: int) -> None:
        with patch.object(Tuning, "round", autospec=True, side_effect=Tuning.round) as rounded:
            done = compress(fitted, photo[0], target_bytes=target, iterations=100)
        assert 0.99 * target <= len(done.data) <= target
        # the others are of no iterations: they ask for a size
        assert sum(call.args[1] > 0 for call in rounded.call_args_list) <= most

    def test_scene_is_what_the_file_holds(self, photo: Photo, fitted: Scene) -> None:
        done = compress(fitted, photo[0], quality=40, iterations=2)
        assert torch.equal(done.scene.render(), decode(done.data).scene.render())

    def test_quality(self, photo: Photo, fitted: Scene) -> None:
        before = psnr(fitted, photo[0])
        done = compress(fitted, photo[0], quality=quality_for(before))
        assert before - 0.15 < psnr(done.scene, photo[0])

    def test_same_bytes_each_time(self, photo: Photo, fitted: Scene) -> None:
        first, second = (compress(fitted, photo[0], quality=40, iterations=20).data for _ in range(2))
        assert first == second

    def test_an_array_is_an_image(self, photo: Photo, fitted: Scene) -> None:
        array = photo[0].permute(1, 2, 0).numpy()
        expected = compress(fitted, photo[0], quality=30, iterations=2)
        assert compress(fitted, array, quality=30, iterations=2).data == expected.data

    def test_faint_ones_do_not_pay(self, photo: Photo, fitted: Scene) -> None:
        field = fitted.field
        colors = field.merged_colors().detach().clone()
        colors[::3] *= 1e-4
        with_faint = GaussianField(field.means, field.cholesky, colors, field.region_ids, size=field.size)
        # before a descent, which may make them pay
        done = compress(Scene(with_faint, fitted.regions), photo[0], quality=36, iterations=1)
        assert done.scene.num_gaussians <= 200

    @pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
    def test_where_gradients_are_off(self, photo: Photo, fitted: Scene, mode: Callable[[], Any]) -> None:
        image, field = photo[0], fitted.field
        assert fitted.regions is not None
        expected = compress(fitted, image, quality=30, iterations=3).data
        with mode():
            same = GaussianField(field.means, field.cholesky, field.colors, field.region_ids, size=field.size)
            scene = Scene(same, RegionMap.from_labels(fitted.regions.labels))
            assert compress(scene, image.clone(), quality=30, iterations=3)
            assert compress(fitted, image, quality=30, iterations=3).data == expected

    def test_refusals(self, photo: Photo, fitted: Scene) -> None:
        image = photo[0]
        for changed, match in (
            ({"image": image[:, :50]}, "image must have shape"),
            ({"objective": "l1"}, "objective must be one of psnr, ms-ssim; got 'l1'"),
            ({"iterations": 0}, "iterations must be at least 1; got 0"),
            ({"quality": 40, "target_bytes": 900}, "quality must be None with target_bytes; got 40"),
            ({"target_bytes": 40}, "target_bytes must be at least [0-9]+ for this scene; got 40"),
        ):
            with pytest.raises(ValueError, match=match):
                compress(**{"scene": fitted, "image": image, **changed})


class TestSoftBits:
    def test_they_follow_the_files(self, fitted: Scene) -> None:
        # weaker and rounder Gaussians make a smaller file, by about as much
        field, quantizer = fitted.field, Quantizer(150, fitted.size)
        means, cholesky, colors = (t.detach() for t in (field.means, field.cholesky, field.merged_colors()))
        changed = (0.5 * colors, cholesky), (colors, cholesky * torch.tensor([1.0, 0.3, 1.0]))
        for new_colors, new_cholesky in changed:
            other = GaussianField(means, new_cholesky, new_colors, field.region_ids, size=field.size)
            files = [SceneWriter(Scene(f, fitted.regions)).write_rounded(150) for f in (field, other)]
            saved = 8 * (len(files[0]) - len(files[1]))
            told = float(
                (soft_bits(cholesky, colors, quantizer) - soft_bits(new_cholesky, new_colors, quantizer)).sum()
            )
            assert saved > 0 and 0.5 * saved < told < 1.6 * saved

    def test_gradients(self) -> None:
        generator = torch.Generator().manual_seed(0)
        cholesky = torch.rand(6, 3, generator=generator, dtype=torch.float64) * 4 + 0.8
        colors = torch.rand(6, 3, generator=generator, dtype=torch.float64) - 0.5
        quantizer = Quantizer(150, (48, 64))
        inputs = cholesky.requires_grad_(), colors.requires_grad_()
        assert torch.autograd.gradcheck(lambda a, b: soft_bits(a, b, quantizer), inputs)

    def test_tiny_ones_are_no_cheaper(self) -> None:
        cholesky = torch.tensor([[0.1, 0.0, 0.1]], requires_grad=True)
        soft_bits(cholesky, torch.ones(1, 3), Quantizer(150, (48, 64))).sum().backward()
        assert cholesky.grad is not None and not cholesky.grad[:, ::2].any()

    def test_bits_are_spared_at_the_same_error(
        self, photo: Photo, fitted: Scene, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        spared = compress(fitted, photo[0], target_bytes=1100).scene
        monkeypatch.setattr("kcgs.rate.tuning._BIT", 0.0)
        assert psnr(compress(fitted, photo[0], target_bytes=1100).scene, photo[0]) + 0.05 < psnr(spared, photo[0])
