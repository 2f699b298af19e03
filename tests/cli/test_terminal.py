"""Ctrl-C, outputs that cannot be written, renders that do not fit: what a command does at a terminal."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import NoReturn

import pytest
import torch

import kcgs.rate  # imports the functions of other modules before a test replaces one
from kcgs import GaussianField, Scene
from kcgs.data import save_image
from tests.cli.conftest import Kcgs


@pytest.fixture(autouse=True)
def _files(photo: None) -> None:
    for suffix in ("safetensors", "kcgs"):
        Scene(GaussianField.random(5, (32, 48), seed=0)).save(f"scene.{suffix}")
    save_image("big.png", torch.zeros(3, 64, 64))


def interrupt(*_: object, **__: object) -> NoReturn:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("kcgs.segment.segment", ("fit", "big.png", "-n", "5")),
        ("kcgs.fitting.fit", ("fit", "photo.png", "-n", "5", "--regions", "none")),
        ("kcgs.files.encode", ("encode", "scene.safetensors", "-o", "new.kcgs")),
    ],
)
def test_ctrl_c(kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch, name: str, arguments: tuple[str, ...]) -> None:
    before = set(Path().iterdir())
    module, _, function = name.rpartition(".")
    monkeypatch.setattr(import_module(module), function, interrupt)
    assert kcgs(*arguments) == (130, "", "")
    assert set(Path().iterdir()) == before


def test_closed_standard_output() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "kcgs", "models"]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, b"")


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
def test_outputs_are_tried_before_the_work(kcgs: Kcgs, arguments: tuple[str, ...]) -> None:
    suffix = {"export": ".onnx", "encode": ".kcgs", "fit": ".safetensors"}.get(arguments[0], ".png")
    Path(f"folder{suffix}").mkdir()
    before = sorted(Path().rglob("*"))
    option = "--output" if arguments[-1] == "-o" else arguments[-1]
    for place, status in (("folder", 1), ("nowhere/x", 2)):
        # the input is missing, too, which would be found later
        code, out, err = kcgs(arguments[0], f"no-{arguments[1]}", *arguments[2:], f"{place}{suffix}")
        assert (code, out, err.count("\n")) == (status, "", 1) and err.startswith(f"kcgs: {option} "), err
        assert sorted(Path().rglob("*")) == before


def test_a_sealed_folder(kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> NoReturn:  # the tests may run as root, to whom a mode forbids nothing
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("kcgs._atomic.tempfile.TemporaryFile", refuse)
    run = kcgs("render", "scene.safetensors", "-o", "large.png")
    assert run.code == 1 and run.err.startswith("kcgs: --output cannot be written into '")
    assert run.err.endswith("': Permission denied\n")


@pytest.mark.parametrize("option", ["--scale=400", "--scale=1e6"])
def test_renders_that_do_not_fit_into_memory(kcgs: Kcgs, monkeypatch: pytest.MonkeyPatch, option: str) -> None:
    monkeypatch.setattr("kcgs._memory.free_memory", lambda: 1e9)
    code, out, err = kcgs("render", "scene.kcgs", "-o", "large.png", option)
    assert (code, out) == (1, "") and err.startswith("kcgs: size asks for ") and err.count("\n") == 1
    if option != "--scale=1e6":
        assert "asks for 19200 x 12800 pixels, which need about 8.8 GB of memory; 1.0 GB are free" in err
    assert not Path("large.png").exists()


def test_free_memory() -> None:
    assert 1e7 < kcgs._memory.free_memory() < 1e15
