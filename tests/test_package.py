"""What the package promises from outside: names, a light import."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import kcgs

ROOT = Path(kcgs.__file__).resolve().parent.parent


def test_public_names() -> None:
    for name in (
        "GaussianField",
        "RegionSplatRenderer",
        "RegionMap",
        "FitConfig",
        "Scene",
        "evaluate",
        "fit",
        "load",
        "save",
    ):
        assert name in kcgs.__all__
        assert hasattr(kcgs, name)
    for name in ("region_splat", "edge_band", "psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim"):
        assert name in kcgs.functional.__all__


def run(code: str, *arguments: str) -> str:
    command = [sys.executable, "-W", "error", "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_an_import_changes_nothing() -> None:
    code = """
import os, signal, sys
sys.argv = ["kcgs", "fit"]
before = dict(os.environ), signal.getsignal(signal.SIGINT), sys.unraisablehook
import kcgs
assert "torch" not in sys.modules
kcgs.Scene, kcgs.fit, kcgs.functional.psnr
assert before == (dict(os.environ), signal.getsignal(signal.SIGINT), sys.unraisablehook)
"""
    run(code)


@pytest.mark.parametrize(
    "arguments",
    [
        ("--help",),
        ("--version",),
        ("fit",),
        ("fit", "--help"),
        ("fit", "photo.png", "--seed", "x"),
        ("fit", "photo.png", "-n", "5", "--target-bytes", "900"),
        ("fit", "photo.png", "-o", "scene.txt"),
        ("fit-many", "photos", "-o", "out", "--target-bytes", "900", "--suffix", ".safetensors"),
        ("render", "scene.png", "-o", "large.png"),
    ],
    ids=" ".join,
)
def test_help_and_usage_errors_load_no_torch(arguments: tuple[str, ...]) -> None:
    code = """
import sys
from kcgs.cli import main
try:
    main()
except SystemExit:
    print(*[name for name in ("torch", "numpy", "numba") if name in sys.modules])
"""
    assert run(code, *arguments).splitlines()[-1] == ""


def test_imports_are_light() -> None:
    """Importing kcgs, then what is imported on its own, loads no library that only some calls need."""
    heavy = (
        "PIL",
        "kornia",
        "matplotlib",
        "numba",
        "onnx",
        "onnx_ir",
        "onnxruntime",
        "rich",
        "scipy",
        "constriction",
        "ray",
        "skimage",
        "transformers",
        "triton",
        "typer",
    )
    modules = ("kcgs", "kcgs.functional", "kcgs.segment")
    code = (
        "import sys, importlib\n"
        f"for name in {modules!r}:\n"
        "    importlib.import_module(name)\n"
        f"    print(name, *[m for m in {heavy!r} if m in sys.modules])\n"
    )
    assert run(code).split() == list(modules)
