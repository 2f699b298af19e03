"""encode and decode, and the other commands that take compressed files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from kcgs import load, save
from kcgs.data import load_image, save_image
from kcgs.functional import psnr
from tests.cli.conftest import Kcgs
from tests.codec.conftest import make_scene

SIZE = (32, 48)


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_scene(40)


def save_scene(num_gaussians: int) -> None:
    scene = make_scene(num_gaussians, SIZE)
    save("scene.safetensors", scene)
    save_image("photo.png", scene.render())


class TestEncode:
    def test_goals(self, kcgs: Kcgs) -> None:
        report = json.loads(kcgs("encode", "scene.safetensors", "-o", "a.kcgs", "--target-bytes", 400, "--json").out)
        assert report["bytes"] == Path("a.kcgs").stat().st_size <= 400 and report["regions"] == 3
        assert report["bits_per_pixel"] == pytest.approx(8 * report["bytes"] / (SIZE[0] * SIZE[1]))
        finer = json.loads(kcgs("encode", "scene.safetensors", "-o", "a.kcgs", "--quality", 70, "--json").out)
        assert finer["bytes"] > report["bytes"] and finer["psnr_to_scene"] > 69
        scene = json.loads(kcgs("info", "scene.safetensors", "--json").out)
        assert scene["bits_per_pixel"] is None and "bits_per_pixel" not in kcgs("info", "scene.safetensors").out

    def test_with_the_image(self, kcgs: Kcgs) -> None:
        files = []
        for options in ([], ["--objective", "l2"]):
            arguments = ["encode", "scene.safetensors", "-o", "a.kcgs", "--image", "photo.png", "--target-bytes", 300]
            assert kcgs(*arguments, *options).code == 0
            files.append(Path("a.kcgs").read_bytes())
            assert len(files[-1]) <= 300
        assert files[0] != files[1]

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("--target-bytes", 900, "--quality", 40), 2, "'--quality': must be None with target_bytes"),
            (("--target-bytes", 9), 2, "'--target-bytes': must be at least"),
        ],
    )
    def test_failure_writes_nothing(self, kcgs: Kcgs, arguments: tuple[object, ...], code: int, words: str) -> None:
        run = kcgs("encode", "scene.safetensors", "-o", "a.kcgs", *arguments)
        assert run.code == code and words in run.err and not Path("a.kcgs").exists()


class TestDecode:
    @pytest.fixture(autouse=True)
    def _layers(self, _files: None) -> None:
        """Replace the scene by one whose file has several layers."""
        save_scene(400)

    def test_whole_and_first_bytes(self, kcgs: Kcgs) -> None:
        kcgs("encode", "scene.safetensors", "-o", "a.kcgs")
        report = json.loads(kcgs("decode", "a.kcgs", "-o", "whole.png", "--json").out)
        assert report == {"height": SIZE[0], "width": SIZE[1], "bytes": Path("whole.png").stat().st_size}
        kcgs("decode", "a.kcgs", "-o", "part.png", "--bytes", Path("a.kcgs").stat().st_size // 2)
        image = load_image("photo.png")
        whole, part = (float(psnr(load_image(name), image)) for name in ("whole.png", "part.png"))
        assert whole > 35 and whole > part + 3

    def test_a_truncated_file_is_said(self, kcgs: Kcgs) -> None:
        kcgs("encode", "scene.safetensors", "-o", "a.kcgs")
        data = Path("a.kcgs").read_bytes()
        Path("a.kcgs").write_bytes(data[: len(data) // 2])
        code, _, err = kcgs("decode", "a.kcgs", "-o", "a.png")
        assert code == 0 and err.startswith("warning: a.kcgs ends after ")

    def test_damage(self, kcgs: Kcgs) -> None:
        Path("a.kcgs").write_bytes(b"kcgs\1 and so on")
        code, _, err = kcgs("decode", "a.kcgs", "-o", "a.png")
        assert code == 1 and err.startswith("kcgs: ") and not Path("a.png").exists()


def test_other_commands_take_a_file(kcgs: Kcgs) -> None:
    kcgs("encode", "scene.safetensors", "-o", "a.kcgs")
    report = json.loads(kcgs("info", "a.kcgs", "--json").out)
    assert report["num_gaussians"] == load("a.kcgs").num_gaussians and report["regions"] == 3
    assert report["bytes"] == Path("a.kcgs").stat().st_size
    kcgs("render", "a.kcgs", "-o", "a.png")
    assert torch.equal(load_image("a.png"), (load("a.kcgs").render() * 255).round() / 255)
    assert "psnr" in json.loads(kcgs("eval", "a.kcgs", "photo.png", "--json").out)
    assert kcgs("export", "a.kcgs", "-o", "a.onnx").code == 0 and Path("a.onnx").stat().st_size > 1000
