"""Scenes in files, by their suffix; what is in a .safetensors file is tested in test_storage.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from kcgs import Scene, fit, load, save
from kcgs.codec import encode
from kcgs.data import load_image
from kcgs.rate import compress
from tests.cli.conftest import Kcgs

from .cli.conftest import kcgs, photo  # noqa: F401  fixtures


@pytest.fixture
def scene() -> Scene:
    return fit("photo.png", "mask.png", 20, iterations=30).scene


@pytest.mark.usefixtures("photo")
class TestSave:
    def test_an_image_gives_the_file_of_the_command(self, kcgs: Kcgs) -> None:  # noqa: F811
        assert kcgs("fit", "photo.png", "--regions", "mask.png", "-n", 20, "--iterations", 30, "-o", "a.kcgs").code == 0
        scene = fit("photo.png", "mask.png", 20, iterations=30).scene
        assert scene.save("b.kcgs", image="photo.png") == Path("b.kcgs").stat().st_size
        assert Path("a.kcgs").read_bytes() == Path("b.kcgs").read_bytes()

    @pytest.mark.parametrize("goal", [{"quality": 30.0}, {"target_bytes": 250}, {"target_psnr": 20.0}])
    def test_goals(self, scene: Scene, goal: dict[str, Any]) -> None:
        options: dict[str, Any] = {**goal, "seed": 1, "min_sigma": 1.5}
        save("image.kcgs", scene, image="photo.png", **options)
        assert Path("image.kcgs").read_bytes() == compress(scene, load_image("photo.png"), **options).data
        if "target_psnr" not in goal:
            save("plain.kcgs", scene, **goal)
            assert Path("plain.kcgs").read_bytes() == encode(scene, **goal)

    @pytest.mark.parametrize(
        ("name", "keywords", "message"),
        [
            ("a.safetensors", {"quality": 40.0}, "quality must be None for a .safetensors file, .*; got 40.0"),
            ("a.safetensors", {"image": torch.ones(3, 40, 60)}, "image must be None for a .safetensors file"),
            ("a.kcgs", {"target_psnr": 30.0}, "target_psnr must be None without an image; got 30.0"),
            ("a.kcgs", {"objective": "l2"}, "objective must be None without an image; got 'l2'"),
        ],
    )
    def test_refused(self, scene: Scene, name: str, keywords: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=f"^{message}"):
            save(name, scene, **keywords)
        assert not Path(name).exists()


def test_load_takes_a_scene_of_the_zoo() -> None:
    assert load("zoo:chelsea-500").num_gaussians == 500
    with pytest.raises(ValueError, match="zoo entry must be one of .*; got 'zoo:cat'"):
        load("zoo:cat")
