"""What the package promises from outside: names, a light import."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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
    out = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == list(modules)
