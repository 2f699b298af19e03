"""What the package promises from outside: public names, and imports that are light and change nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import kcgs

PUBLIC = {
    "FitConfig", "FitResult", "GaussianField", "RegionMap", "RegionSplatRenderer", "Scene",
    "evaluate", "fit", "load", "save",
}  # fmt: skip
FUNCTIONAL = {"region_splat", "edge_band", "psnr", "ssim", "ms_ssim", "ef_psnr", "ef_ssim"}
PRIVATE = {"cli", "compiled", "kernels", "maps", "recipes"}
# what only some calls need
HEAVY = {
    "PIL", "constriction", "kornia", "matplotlib", "numba", "onnx", "onnx_ir", "onnxruntime", "ray", "rich", "scipy",
    "skimage", "transformers", "triton", "typer",
}  # fmt: skip
# exit status 0 and 2, and none of them needs a tensor
COMMANDS = (
    "--help",
    "--version",
    "fit",
    "fit --help",
    "fit photo.png --seed x",
    "fit photo.png -n 5 --target-bytes 900",
    "fit photo.png -o scene.txt",
    "fit-many photos -o out --target-bytes 900 --suffix .safetensors",
    "render scene.png -o large.png",
)
RUN_COMMANDS = """
import sys
from kcgs.cli import main
for line in sys.stdin:
    sys.argv = ["kcgs", *line.split()]
    try:
        main()
    except SystemExit as stop:
        assert stop.code in (0, None, 2), line
    assert not {"torch", "numpy", "numba"} & sys.modules.keys(), line
"""
IMPORT = """
import json, os, signal, sys
def process():
    return dict(os.environ), signal.getsignal(signal.SIGINT), sys.unraisablehook
sys.argv = ["kcgs", "fit"]
before = process()
import kcgs
assert "torch" not in sys.modules
import kcgs.functional, torch
torch.ops.kcgs.region_splat  # an exported program needs no other import
kcgs.Scene, kcgs.fit, kcgs.segment
assert before == process()
print(json.dumps([*sys.modules]))
kcgs.fit(torch.rand(3, 9, 9), num_gaussians=9, iterations=3)
print(json.dumps([*sys.modules]))
"""


def run(code: str, text: str = "") -> str:
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, input=text, stdout=subprocess.PIPE, text=True, check=True).stdout


def test_public_names() -> None:
    assert set(kcgs.__all__) >= PUBLIC
    assert set(kcgs.functional.__all__) >= FUNCTIONAL
    assert all(hasattr(kcgs, name) for name in kcgs.__all__)


def test_packages_are_attributes_that_no_function_hides() -> None:
    folders = {path.parent.name for path in Path(kcgs.__file__).parent.glob("*/__init__.py")}
    assert {name for name in dir(kcgs) if isinstance(getattr(kcgs, name), ModuleType)} == folders - PRIVATE
    assert not [name for name in kcgs.__all__ if find_spec(f"kcgs.{name}")]


def test_help_and_usage_errors_load_no_torch() -> None:
    run(RUN_COMMANDS, "\n".join(COMMANDS))


def test_an_import_is_light_and_changes_nothing() -> None:
    """A fit loads no compiler of torch: that takes one to three seconds, in every process of `kcgs fit`."""
    imported, fitted = map(json.loads, run(IMPORT).splitlines())
    assert not HEAVY & set(imported)
    assert "torch._dynamo" not in fitted and "numba" in fitted
