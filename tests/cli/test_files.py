"""Compressed files from the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import torch
from typer.testing import CliRunner

from kcgs import save
from kcgs.cli import app
from kcgs.cli.options import Objective
from kcgs.codec import decode
from kcgs.data import load_image, save_image
from kcgs.fitting import FitConfig
from tests.codec.conftest import make_scene

runner = CliRunner()


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save(tmp_path / "scene.safetensors", make_scene(120, (48, 64)))
    return tmp_path / "scene.safetensors"


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    across = torch.linspace(0, 1, 64).expand(3, 48, 64).clone()
    across[:, 10:30, 20:40] = 0.9
    save_image(tmp_path / "photo.png", across)
    return tmp_path / "photo.png"


def run(*arguments: object, code: int = 0) -> str:
    result = runner.invoke(app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return result.stdout


class TestEncode:
    def test_goals(self, scene: Path, tmp_path: Path) -> None:
        out = tmp_path / "a.kcgs"
        report = json.loads(run("encode", scene, "-o", out, "--target-bytes", 800, "--json"))
        assert report["bytes"] == out.stat().st_size <= 800 and report["regions"] == 3
        finer = json.loads(run("encode", scene, "-o", out, "--quality", 60, "--json"))
        assert finer["bytes"] > report["bytes"]
        assert report["bits_per_pixel"] == pytest.approx(8 * report["bytes"] / (48 * 64))
        exact = json.loads(run("info", scene, "--json"))
        assert exact["bits_per_pixel"] is None and "bits_per_pixel" not in run("info", scene)

    def test_with_the_image(self, scene: Path, photo: Path, tmp_path: Path) -> None:
        run("encode", scene, "-o", tmp_path / "a.kcgs", "--target-bytes", 700, "--image", photo)
        assert (tmp_path / "a.kcgs").stat().st_size <= 700

    def test_for_a_metric(self, scene: Path, photo: Path, tmp_path: Path) -> None:
        out, wanted = tmp_path / "a.kcgs", ("--target-bytes", 700, "--objective", "ms-ssim")
        run("encode", scene, "-o", out, "--target-bytes", 700, "--image", photo)
        usual = out.read_bytes()
        run("encode", scene, "-o", out, *wanted, "--image", photo)
        assert out.stat().st_size <= 700 and out.read_bytes() != usual
        run("fit", photo, "--regions", "none", "--iterations", 30, "-o", out, *wanted)
        assert out.stat().st_size <= 700
        run("encode", scene, "-o", out, *wanted, code=2)

    def test_nothing_is_written_on_failure(self, scene: Path, tmp_path: Path) -> None:
        arguments = ["encode", str(scene), "-o", str(tmp_path / "a.kcgs"), "--target-bytes", "900", "--quality", "40"]
        assert "quality must be None with target_bytes" in str(runner.invoke(app, arguments).exception)
        result = runner.invoke(app, ["encode", str(scene), "-o", str(tmp_path / "a.kcgs"), "--target-bytes", "9"])
        assert result.exit_code == 1 and "target_bytes must be at least" in str(result.exception)
        assert not (tmp_path / "a.kcgs").exists()


class TestDecode:
    def test_whole_and_its_beginning(self, scene: Path, tmp_path: Path) -> None:
        file, whole, part = tmp_path / "a.kcgs", tmp_path / "a.png", tmp_path / "b.png"
        run("encode", scene, "-o", file)
        run("decode", file, "-o", whole)
        half = len(file.read_bytes()) // 2
        result = runner.invoke(app, ["decode", str(file), "-o", str(part), "--bytes", str(half)])
        assert result.exit_code == 0
        assert load_image(whole).shape == load_image(part).shape == (3, 48, 64)
        assert not torch.equal(load_image(whole), load_image(part))

    def test_enlarged(self, scene: Path, tmp_path: Path) -> None:
        run("encode", scene, "-o", tmp_path / "a.kcgs")
        run("decode", tmp_path / "a.kcgs", "-o", tmp_path / "a.png", "--scale", 2)
        assert load_image(tmp_path / "a.png").shape == (3, 96, 128)

    def test_damage(self, tmp_path: Path) -> None:
        (tmp_path / "a.kcgs").write_bytes(b"kcgs\1 and so on")
        result = runner.invoke(app, ["decode", str(tmp_path / "a.kcgs"), "-o", str(tmp_path / "a.png")])
        assert result.exit_code == 1 and str(result.exception)
        assert not (tmp_path / "a.png").exists()


class TestOtherCommands:
    def test_take_a_file(self, scene: Path, photo: Path, tmp_path: Path) -> None:
        file = tmp_path / "a.kcgs"
        run("encode", scene, "-o", file)
        held = json.loads(run("info", file, "--json"))
        assert held["num_gaussians"] == decode(file.read_bytes()).scene.num_gaussians and held["regions"] == 3
        assert held["bytes"] == file.stat().st_size
        run("render", file, "-o", tmp_path / "a.png")
        assert "psnr" in json.loads(run("eval", file, photo, "--json"))
        run("export", file, "-o", tmp_path / "a.onnx")
        assert (tmp_path / "a.onnx").stat().st_size > 1000


class TestFit:
    def test_objectives_are_those_of_fits(self) -> None:
        choices, _ = get_args(get_args(Objective)[0])  # of Annotated[Literal[...] | None, ...]
        assert get_args(choices) == get_args(get_type_hints(FitConfig)["objective"])

    def test_to_a_budget(self, photo: Path, tmp_path: Path) -> None:
        file = tmp_path / "a.kcgs"
        report = json.loads(
            run("fit", photo, "--regions", "none", "--iterations", 60, "--target-bytes", 400, "-o", file, "--json")
        )
        assert report["bytes"] == file.stat().st_size <= 400
        assert report["num_gaussians"] == decode(file.read_bytes()).scene.num_gaussians

    def test_to_a_file(self, photo: Path, tmp_path: Path) -> None:
        file = tmp_path / "a.kcgs"
        run("fit", photo, "--regions", "none", "--iterations", 60, "-n", 50, "-o", file)
        assert 1 <= decode(file.read_bytes()).scene.num_gaussians <= 50

    def test_refusals(self, photo: Path, tmp_path: Path) -> None:
        run("fit", photo, "-n", 50, "--target-bytes", 400, "-o", tmp_path / "a.kcgs", code=2)
        result = runner.invoke(app, ["fit", str(photo), "--target-bytes", "400", "-o", str(tmp_path / "a.safetensors")])
        assert result.exit_code == 2 and "--output must end in .kcgs" in " ".join(result.output.split())
