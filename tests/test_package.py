"""What the package promises from outside: names, a light import, layers, the wheel."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import kcgs

ROOT = Path(kcgs.__file__).resolve().parent.parent

# lower imports nothing higher; a folder may import itself and anything to its right
LAYERS = [
    {"cli"},
    {"bench"},
    {"view", "zoo", "plots"},
    {"rate"},
    {"fit", "codec", "onnx", "segment", "io"},
    {"data", "editing", "evaluate", "storage"},
    {"scene"},
    {"nn"},
    {"functional"},
    {"kernels"},
    {"_check", "_atomic", "_shipped", "engine"},
]


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
        "torchmetrics",
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


def test_imports_go_one_way() -> None:
    level = {name: i for i, names in enumerate(LAYERS) for name in names}
    for path in (ROOT / "kcgs").rglob("*.py"):
        here = path.relative_to(ROOT / "kcgs").parts[0].removesuffix(".py")
        if here == "__init__":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").startswith("kcgs."):
                there = (node.module or "").split(".")[1]
                assert level[there] >= level[here], f"{path.name} of {here} imports {there}"
                assert level[there] > level[here] or there == here, f"{path.name} of {here} imports its sibling {there}"


def test_files_stay_short() -> None:
    for path in (ROOT / "kcgs").rglob("*.py"):
        assert len(path.read_text().splitlines()) <= 420, path
