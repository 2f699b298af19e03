"""Ctrl-C, progress, outputs that cannot be written, renders that do not fit: what a command does at a terminal."""

from __future__ import annotations

import json
import os
import signal
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
    def test_one_line(
        self, files: Path, run: Any, monkeypatch: pytest.MonkeyPatch, name: str, arguments: tuple[str, ...]
    ) -> None:
        before = set(files.iterdir())
        module, _, function = name.rpartition(".")
        monkeypatch.setattr(import_module(module), function, press)
        assert run(*arguments) == (130, "", "kcgs: interrupted\n")
        assert set(files.iterdir()) == before

    def test_libraries_that_make_another_error_of_it(self, run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        def half_loaded(*_: object) -> NoReturn:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                raise ImportError("a module is half loaded") from None
            raise AssertionError

        monkeypatch.setattr(kcgs.scene, "load", half_loaded)
        assert run("encode", "scene.safetensors", "-o", "scene.kcgs") == (130, "", "kcgs: interrupted\n")

    def test_after_the_fit_what_is_saved_is_said(self, run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        measure = kcgs.cli.fit.report_fit

        def interrupted(*arguments: Any) -> dict[str, Any]:
            os.kill(os.getpid(), signal.SIGINT)
            return measure(*arguments)

        monkeypatch.setattr(kcgs.cli.fit, "report_fit", interrupted)
        code, out, err = run("fit", "photo.png", "-n", "5", "--iterations", "3", "--regions", "none", "--json")
        assert code == 130 and json.loads(out)["num_gaussians"]
        assert err.endswith("kcgs: interrupted: saved the best so far to photo.safetensors\n")

    def test_while_many_are_fitted(self, files: Path, run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(kcgs.cli.many_jobs, "_warm_up", lambda *_: None)
        monkeypatch.setattr(kcgs.cli.many_jobs, "fit_into", press)
        code, out, err = run("fit-many", "photos", "-o", "out", "-n", "5", "--workers", "1")
        assert (code, out) == (130, "")
        assert err == "kcgs: interrupted: 0 of 2 images are done; the same command goes on\n"

    def test_after_one_of_many_has_failed(self, files: Path, run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(kcgs.cli.many_jobs, "_warm_up", lambda *_: None)
        monkeypatch.setattr(kcgs.cli.many_jobs, "fit_into", press)
        (files / "photos/a.png").write_bytes(b"no image")
        code, out, err = run("fit-many", "photos", "-o", "out", "-n", "5", "--workers", "1")
        assert err == "kcgs: interrupted: 0 of 2 images are done, 1 failed; the same command goes on\n"


def test_a_reader_who_leaves(files: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "kcgs.cli", "info", "scene.safetensors"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


class TestOutputs:
    @pytest.mark.parametrize(
        "arguments",
        [
            ("fit", "photo.png", "-o"),
            ("fit", "photo.png", "--plot"),
            ("fit", "photo.png", "--checkpoint"),
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
        place += ".png" if arguments[-1] == "--plot" else suffix
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
    @pytest.mark.parametrize("asked", [("--scale", "400"), ("--size", "19200x12800"), ("--scale", "1e300")])
    @pytest.mark.parametrize("command", ["render", "decode"])
    def test_renders_that_do_not_fit(
        self, files: Path, run: Any, monkeypatch: pytest.MonkeyPatch, command: str, asked: tuple[str, str]
    ) -> None:
        monkeypatch.setattr("kcgs._check._free_memory", lambda: 1e9)
        kcgs.load("scene.safetensors").save("scene.kcgs")
        code, out, err = run(command, "scene.kcgs", "-o", "large.png", *asked)
        assert (code, out) == (1, "") and err.startswith(f"kcgs: {asked[0]}") and err.count("\n") == 1
        if asked[1] != "1e300":
            assert "asks for 19200 x 12800 pixels, which need about 8.8 GB of memory; 1.0 GB are free" in err
        assert not (files / "large.png").exists()

    def test_free_memory(self) -> None:
        assert 1e7 < kcgs._check._free_memory() < 1e15
