"""Rounding with an eye on the image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene
from kcgs.codec import decode, encode
from kcgs.rate import compress, quality_for

from .conftest import Photo, psnr


class TestCompress:
    def test_less_error_at_the_same_bytes(self, photo: Photo, fitted: Scene) -> None:
        image, target = photo[0], 1300
        plain = encode(fitted, target_bytes=target)
        tuned = compress(fitted, image, target_bytes=target)
        for data in (plain, tuned.data):
            assert 0.97 * target < len(data) <= target
        assert psnr(decode(plain).scene, image) + 0.1 < psnr(tuned.scene, image)

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
        done = compress(Scene(with_faint, fitted.regions), photo[0], quality=36, iterations=2)
        assert len(done.scene) <= 200

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
            ({"iterations": 0}, "iterations must be at least 1; got 0"),
            ({"quality": 40, "target_bytes": 900}, "exclude each other"),
            ({"target_bytes": 40}, "target_bytes must be at least [0-9]+ for this scene; got 40"),
        ):
            with pytest.raises(ValueError, match=match):
                compress(**{"scene": fitted, "image": image, **changed})
