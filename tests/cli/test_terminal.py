"""Ctrl-C, progress, outputs that cannot be written, renders that do not fit: what a command does at a terminal."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import pytest
import torch

import kcgs.cli
import kcgs.page.server
import kcgs.rate  # modules that take functions of others take them before one is replaced
from kcgs import GaussianField, Scene
from kcgs.data import save_image


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for name in ("photo.png", "photos/a.png", "photos/b.png"):
        save_image(name, torch.linspace(0.0, 1.0, 48).expand(3, 32, 48))
    Scene(GaussianField.random(5, (32, 48), seed=0)).save("scene.safetensors")
    return tmp_path


@pytest.fixture
def run(files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["kcgs", *arguments])
        with pytest.raises(SystemExit) as stop:
            kcgs.cli.main()
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out, captured.err

    return call


def press(*_: object, **__: object) -> NoReturn:
    raise KeyboardInterrupt


class TestCtrlC:
    @pytest.mark.parametrize(
        ("name", "arguments"),
        [
            ("kcgs.segment.segment", ("fit", "photo.png", "-n", "5")),
            ("kcgs.segment.segment_with_scores", ("segment", "photo.png", "-o", "map.png")),
            ("kcgs.fitting.fit", ("fit", "photo.png", "-n", "5", "--regions", "none")),
            ("kcgs.codec.encode", ("encode", "scene.safetensors", "-o", "scene.kcgs")),
            ("kcgs.page.server.serve", ("view", "scene.safetensors")),
        ],
    )
    def test_exit_status(
        self, files: Path, run: Any, monkeypatch: pytest.MonkeyPatch, name: str, arguments: tuple[str, ...]
    ) -> None:
        before = set(files.iterdir())
        module, _, function = name.rpartition(".")
        monkeypatch.setattr(import_module(module), function, press)
        assert run(*arguments) == (130, "", "")
        assert set(files.iterdir()) == before


def test_a_reader_who_leaves(files: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "kcgs.cli", "info", "scene.safetensors"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


class TestOutputs:
    @pytest.mark.parametrize(
        "arguments",
        [
            ("fit", "photo.png", "-o"),
            ("render", "scene.safetensors", "-o"),
            ("segment", "photo.png", "-o"),
            ("segment", "photo.png", "-o", "map.png", "--overlay"),
            ("encode", "scene.safetensors", "-o"),
            ("export", "scene.safetensors", "-o"),
        ],
    )
    @pytest.mark.parametrize("place", ["folder", "nowhere/x", "sealed/x"])
    def test_are_tried_before_the_work(
        self, files: Path, run: Any, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], place: str
    ) -> None:
        suffix = {"export": ".onnx", "encode": ".kcgs", "fit": ".safetensors"}.get(arguments[0], ".png")
        place += suffix
        (files / f"folder{Path(place).suffix}").mkdir()
        if place.startswith("sealed"):
            (files / "sealed").mkdir()
            make = tempfile.TemporaryFile

            # the tests may run as root, to whom a mode forbids nothing
            def refuse(*, dir: Path) -> Any:
                if dir.name == "sealed":
                    raise PermissionError(13, "Permission denied")
                return make(dir=dir)

            monkeypatch.setattr("kcgs._atomic.tempfile.TemporaryFile", refuse)
        before = sorted(files.rglob("*"))
        # an input that is not there is found later
        code, out, err = run(arguments[0], f"no-{arguments[1]}", *arguments[2:], place)
        option = "--output" if arguments[-1] == "-o" else arguments[-1]
        assert (code, out) == (1, "") and err.startswith(f"kcgs: {option} ") and err.count("\n") == 1, err
        assert sorted(files.rglob("*")) == before


class TestMemory:
    @pytest.mark.parametrize("asked", [("--scale", "400"), ("--size", "19200x12800"), ("--scale", "1e6")])
    @pytest.mark.parametrize("command", ["render", "decode"])
    def test_renders_that_do_not_fit(
        self, files: Path, run: Any, monkeypatch: pytest.MonkeyPatch, command: str, asked: tuple[str, str]
    ) -> None:
        monkeypatch.setattr("kcgs._memory.free_memory", lambda: 1e9)
        kcgs.load("scene.safetensors").save("scene.kcgs")
        code, out, err = run(command, "scene.kcgs", "-o", "large.png", *asked)
        assert (code, out) == (1, "") and err.startswith("kcgs: size asks for ") and err.count("\n") == 1
        if asked[1] != "1e6":
            assert "asks for 19200 x 12800 pixels, which need about 8.8 GB of memory; 1.0 GB are free" in err
        assert not (files / "large.png").exists()

    def test_free_memory(self) -> None:
        assert 1e7 < kcgs._memory.free_memory() < 1e15
