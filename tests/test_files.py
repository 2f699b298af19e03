"""Scenes in files, by their suffix; what is in a .safetensors file is tested in test_storage.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from kcgs import GaussianField, Scene, fit, save
from kcgs.codec import encode
from kcgs.rate import Compressed
from tests.cli.conftest import Kcgs

from .cli.conftest import kcgs, photo  # noqa: F401  fixtures


@pytest.fixture
def scene() -> Scene:
    return Scene(GaussianField.random(20, (40, 60), seed=0))


@pytest.mark.usefixtures("photo")
class TestSave:
    def test_an_image_gives_the_file_of_the_command(self, kcgs: Kcgs) -> None:  # noqa: F811
        assert kcgs("fit", "photo.png", "--regions", "mask.png", "-n", 20, "--iterations", 5, "-o", "a.kcgs").code == 0
        scene = fit("photo.png", "mask.png", 20, iterations=5).scene
        assert scene.save("b.kcgs", image="photo.png") == Path("b.kcgs").stat().st_size
        assert Path("a.kcgs").read_bytes() == Path("b.kcgs").read_bytes()

    @pytest.mark.parametrize("goal", [{"quality": 30.0}, {"target_bytes": 250}])
    def test_goals(self, scene: Scene, goal: dict[str, Any]) -> None:
        save("plain.kcgs", scene, **goal)
        assert Path("plain.kcgs").read_bytes() == encode(scene, **goal)

    def test_compression_with_an_image_gets_all_options(self, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
        options: dict[str, Any] = {
            "quality": 30.0, "target_bytes": 250, "target_psnr": 8.0, "objective": "l2", "seed": 1, "min_sigma": 1.5
        }  # fmt: skip
        calls = []

        def record(*arguments: Any, **keywords: Any) -> Compressed:
            calls.append((arguments, keywords))
            return Compressed(b"file", scene)

        monkeypatch.setattr("kcgs.rate.compress", record)
        save("image.kcgs", scene, image="photo.png", **options)
        assert calls == [((scene, "photo.png"), options)] and Path("image.kcgs").read_bytes() == b"file"

    @pytest.mark.parametrize(
        ("name", "keywords", "message"),
        [
            ("a.safetensors", {"quality": 40.0}, "quality must be None for a .safetensors file, .*; got 40.0"),
            ("a.safetensors", {"image": torch.ones(3, 40, 60)}, "image must be None for a .safetensors file"),
            ("a.kcgs", {"target_psnr": 30.0}, "target_psnr must be None without an image; got 30.0"),
        ],
    )
    def test_refused(self, scene: Scene, name: str, keywords: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=f"^{message}"):
            save(name, scene, **keywords)
        assert not Path(name).exists()
