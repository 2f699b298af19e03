"""The wheel: what it holds, and that commands run where nothing else of the project is."""

from __future__ import annotations

import json
import os
import shutil
import site
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

import kcgs
from kcgs.data import save_image

ROOT = Path(kcgs.__file__).resolve().parent.parent
if not (ROOT / "pyproject.toml").is_file():
    pytest.skip("not a source checkout", allow_module_level=True)

# without importing kcgs, which takes seconds
FIND = "import importlib.util; print(importlib.util.find_spec('kcgs').origin)"
# all commands in one process, which imports torch once
RUN_COMMANDS = """
import json, sys
from kcgs.cli import main
for line in sys.stdin:
    sys.argv = ["kcgs", *json.loads(line)]
    try:
        main()
    except SystemExit as stop:
        assert not stop.code, (sys.argv, stop.code)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build from a copy of the tree."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in ("kcgs", "models"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", str(folder), str(source)]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel alone; what it depends on is that of the running environment."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, str(wheel)], check=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "running.pth").write_text("\n".join(site.getsitepackages()))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("work")
    image = torch.full((3, 48, 64), 0.3)
    image[0, 10:30, 20:45] = 0.9
    (folder / "photos").mkdir()
    save_image(folder / "photo.png", image)
    save_image(folder / "photos" / "a.png", image)
    return folder


def without_path() -> dict[str, str]:
    """Return the environment without PYTHONPATH, by which Python would find this checkout."""
    return {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}


def call(environment: Path, folder: Path, command: list[str], text: str = "") -> str:
    process = subprocess.run(
        [str(environment / "bin" / command[0]), *command[1:]],
        input=text, capture_output=True, text=True, cwd=folder, env=without_path(),
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_holds_kcgs_only(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {n.split("/")[0] for n in names} == {"kcgs", f"kcgs-{kcgs.__version__}.dist-info"}
    for name in ("recipes/paper.toml", "py.typed", "models/manifest.json", "page/page.js", "page/kcgs-image.js"):
        assert f"kcgs/{name}" in names
    assert any(n.endswith("licenses/LICENSE") for n in names)
    data = [n for n in names if n.startswith("kcgs/models/")]
    assert {Path(n).suffix for n in data} == {".json", ".md", ".safetensors"}
    assert sum(info.compress_size for info in zipfile.ZipFile(wheel).infolist()) < 3_000_000


def test_it_is_the_wheel_that_runs(environment: Path, folder: Path) -> None:
    assert call(environment, folder, ["kcgs", "--version"]) == f"kcgs {kcgs.__version__}\n"
    origin = call(environment, folder, ["python", "-c", FIND])
    assert Path(origin.strip()).is_relative_to(environment.resolve())


def test_commands(environment: Path, folder: Path) -> None:
    short = ("-n", "10", "--iterations", "10")
    commands = [
        ("models",),
        ("render", "zoo:chart-2x3", "-o", "chart.png", "--size", "60x40"),
        ("fit", "photo.png", *short),
        ("encode", "zoo:chart-2x3", "-o", "chart.kcgs"),
        ("export", "photo.safetensors", "-o", "photo.onnx"),
        ("export", "photo.safetensors", "-o", "photo.html"),
        ("fit-many", "photos", *short, "-o", "many", "--regions", "none"),
    ]
    out = call(environment, folder, ["python", "-c", RUN_COMMANDS], "\n".join(map(json.dumps, commands)))
    assert "chart-2x3" in out
    written = {path.name for path in folder.iterdir()}
    assert written >= {"chart.png", "chart.kcgs", "photo.safetensors", "photo.onnx", "photo.html"}
    assert (folder / "many" / "a.safetensors").is_file()
