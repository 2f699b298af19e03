"""Files of scenes whose image is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from kcgs import GaussianField, RegionMap, Scene
from kcgs.codec import decode, encode
from kcgs.codec.gaussians.quantize import Quantizer
from kcgs.codec.scenes import SceneWriter
from kcgs.optim.ms_ssim import MsSsim
from kcgs.rate import compress, quality_for
from kcgs.rate.bits import soft_bits

from .conftest import Photo, min_sigma, psnr


class TestCompress:
    def test_bytes(self, photo: Photo, scene: Scene) -> None:
        """The file fills its bytes, with less error than one that does not know the image."""
        compressed = compress(scene, photo[0], target_bytes=700, iterations=80, objective="l2")
        assert 0.99 * 700 <= len(compressed.data) <= 700
        plain = decode(encode(scene, target_bytes=700)).scene
        assert psnr(plain, photo[0]) + 0.1 < psnr(compressed.scene, photo[0])
        assert torch.equal(compressed.scene.render(), decode(compressed.data).scene.render())

    def test_quality(self, photo: Photo, scene: Scene) -> None:
        """A file of the scene's quality is nearly as good as the scene, and a PSNR that the scene has is reached."""
        scene_psnr = psnr(scene, photo[0])
        quality = compress(scene, photo[0], iterations=80, quality=quality_for(scene_psnr), objective="l2")
        assert scene_psnr - 0.3 < psnr(quality.scene, photo[0])
        exact = compress(scene, photo[0], iterations=20, target_psnr=scene_psnr - 0.1)
        assert scene_psnr - 0.1 <= psnr(exact.scene, photo[0])

    def test_psnr_beyond_the_scene(self, photo: Photo, scene: Scene) -> None:
        coarse = compress(scene, photo[0], iterations=2, quality=quality_for(psnr(scene, photo[0])), objective="l2")
        assert compress(scene, photo[0], iterations=2, target_psnr=99.0).data == coarse.data

    def test_objective(self, photo: Photo, scene: Scene) -> None:
        images = [
            compress(scene, photo[0], quality=36, iterations=50, objective=name).scene.render()
            for name in ("l2", "ms-ssim")
        ]
        error = MsSsim(photo[0])
        assert error.value(images[1]) < 0.95 * error.value(images[0])

    def test_least_width(self, photo: Photo, scene: Scene) -> None:
        """The descent keeps to the least width, which rounding changes a little."""
        assert min_sigma(compress(scene, photo[0], quality=40, iterations=30, min_sigma=2.0).scene) > 1.0

    def test_faint_gaussians(self, photo: Photo, scene: Scene) -> None:
        """They are removed, unless a descent makes them pay."""
        field = scene.field
        colors = field.merged_colors().detach().clone()
        colors[::3] *= 1e-4
        faint = GaussianField(field.means, field.cholesky, colors, field.region_ids, size=field.size)
        assert compress(Scene(faint, scene.regions), photo[0], quality=36, iterations=1).scene.num_gaussians <= 200

    @pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
    def test_without_gradients(self, photo: Photo, scene: Scene, mode: Callable[[], Any]) -> None:
        image, field = photo[0], scene.field
        assert scene.regions is not None
        expected = compress(scene, image, quality=30, iterations=3).data
        with mode():
            copy = GaussianField(field.means, field.cholesky, field.colors, field.region_ids, size=field.size)
            other = Scene(copy, RegionMap(scene.regions.labels))
            assert compress(other, image.clone(), quality=30, iterations=3)
            assert compress(scene, image, quality=30, iterations=3).data == expected

    @pytest.mark.parametrize(
        ("changes", "match"),
        [
            ({"image": torch.zeros(3, 50, 160)}, "image must have shape"),
            (
                {"objective": "l1", "target_bytes": 900},
                "objective must be ms-ssim or l2 for a file of a size; got 'l1'",
            ),
            ({"objective": "l1"}, "objective must be l2 or ms-ssim for a file of a PSNR; got 'l1'"),
            ({"iterations": 0}, "iterations must be at least 1; got 0"),
            ({"quality": 40, "target_bytes": 900}, "quality must be None with target_bytes; got 40"),
            ({"quality": 40, "target_psnr": 30.0}, "target_psnr must be None with quality or target_bytes; got 30"),
            ({"target_bytes": 40, "iterations": 10**9}, "target_bytes must be at least [0-9]+ for this scene; got 40"),
            ({"target_bytes": 0, "iterations": 10**9}, "target_bytes must be at least 1; got 0"),
            ({"seed": -1}, "seed must be in .*; got -1"),
            ({"min_sigma": -1.0}, "min_sigma must be finite and at least 0 pixels; got -1.0"),
        ],
    )
    def test_exceptions(self, photo: Photo, scene: Scene, changes: dict[str, Any], match: str) -> None:
        with pytest.raises(ValueError, match=match):
            compress(**{"scene": scene, "image": photo[0], **changes})


class TestSoftBits:
    @pytest.mark.parametrize(("brightness", "slant"), [(0.5, 1.0), (1.0, 0.3)])
    def test_against_files(self, scene: Scene, brightness: float, slant: float) -> None:
        """Weaker and rounder Gaussians make a smaller file, by about as much."""
        field, quantizer = scene.field, Quantizer(150, scene.size)
        cholesky, colors = field.cholesky.detach(), field.merged_colors().detach()
        new_cholesky, new_colors = cholesky * torch.tensor([1.0, slant, 1.0]), brightness * colors
        changed = GaussianField(field.means, new_cholesky, new_colors, field.region_ids, size=field.size)
        sizes = [len(SceneWriter(Scene(f, scene.regions)).write_rounded(150)) for f in (field, changed)]
        saved = 8 * (sizes[0] - sizes[1])
        estimate = soft_bits(cholesky, colors, quantizer) - soft_bits(new_cholesky, new_colors, quantizer)
        assert saved > 0 and 0.5 * saved < float(estimate.sum()) < 1.6 * saved

    def test_tiny_gaussians_are_no_cheaper(self) -> None:
        cholesky = torch.tensor([[0.1, 0.0, 0.1]], requires_grad=True)
        soft_bits(cholesky, torch.ones(1, 3), Quantizer(150, (48, 64))).sum().backward()
        assert cholesky.grad is not None and not cholesky.grad[:, ::2].any()

    def test_descent(self, photo: Photo, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
        """A price of bits lowers the error at equal bytes."""
        psnrs = []
        for price in (0.0, 0.9):
            monkeypatch.setattr("kcgs.rate.rate_distortion._BIT_PRICE", price)
            file = compress(scene, photo[0], target_bytes=1100, iterations=100, objective="l2")
            psnrs.append(psnr(file.scene, photo[0]))
        assert psnrs[0] + 0.05 < psnrs[1]
