"""The Triton kernel: that it compiles, and refusals; numbers in triton_cases.py, run in a process of their own.

TRITON_INTERPRET is read when triton is imported, so it must not be set in the process of the other tests.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from kcgs.kernels import SplatInputs, cuda, registry

CASES = Path(__file__).with_name("triton_cases.py")

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton is not installed: pip install triton"
)


@needs_triton
def test_agrees_with_the_reference() -> None:
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    if not torch.cuda.is_available():
        environment |= {"TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(CASES)]
    root = CASES.parent.parent.parent
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout and " skipped" not in done.stdout, done.stdout


TYPES = {
    **dict.fromkeys(("start", "gaussian", "mask_rows", "order", "tiles", "firsts"), "*i64"),
    **dict.fromkeys(("image", "nodes", "colors", "coefficients", "masks", "terms", "grad"), "*fp32"),
    **dict.fromkeys(("pixel_tiles", "rows", "cols", "height", "width", "count"), "i32"),
    "cutoff": "fp32",
}


@needs_triton
@pytest.mark.skipif(cuda._interpreted(), reason="the interpreter does not compile")
@pytest.mark.parametrize("capability", [80, 90])
@pytest.mark.parametrize("channels", [3, 32])
@pytest.mark.parametrize("mapped", [False, True])
def test_compiles_without_a_gpu(
    capability: int, channels: int, mapped: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import triton
    from triton.backends.compiler import GPUTarget

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    block = min(cuda._MAX_CHANNELS, 1 << (channels - 1).bit_length())
    common = {"SIDE": 16, "CHANNELS": channels, "BLOCK": block, "MAPPED": mapped}
    gather = {**common, "GEOMETRY": True, "PIECE": cuda._PIECE}
    for kernel, constants, warps in (
        (cuda._render_tile, common, cuda._RENDER_WARPS),
        (cuda._gather_piece, gather, 1),
    ):
        signature = {name: TYPES.get(name, "constexpr") for name in kernel.arg_names}
        source = triton.compiler.ASTSource(kernel, signature, constants)
        target = GPUTarget("cuda", capability, 32)
        ptx = triton.compile(source, target=target, options={"num_warps": warps, **cuda._OPTIONS}).asm["ptx"]
        assert "ex2.approx" in ptx
        # every sum has one order
        assert not re.search(r"\b(atom|red)\.", ptx)
        # a thread owns its sums: threads exchange nothing, as Triton 3.6 lets them
        assert "shfl" not in ptx or triton.__version__.startswith("3.6.")


def inputs(dtype: torch.dtype = torch.float32) -> SplatInputs:
    arrays = torch.zeros(1, 2, 2, dtype=dtype), torch.ones(1, 2, 3, dtype=dtype), torch.ones(1, 2, 3, dtype=dtype)
    return SplatInputs(*arrays, None, None, (4, 5), 0.0)


def test_float64() -> None:
    with pytest.raises(ValueError, match="backend 'cuda' computes in float32; got torch.float64: use 'tiled'"):
        cuda.steps(inputs(torch.float64))


def test_cpu() -> None:
    with pytest.raises(ValueError, match="backend 'cuda' needs tensors on a CUDA device; got cpu"):
        cuda.steps(inputs())


@pytest.mark.parametrize("installed", [False, True])
def test_auto(installed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_has_triton", lambda: installed)
    device = torch.device("cuda")
    assert registry._choose("auto", device, torch.float32) == ("cuda" if installed else "tiled")
    assert registry._choose("auto", device, torch.float64) == "tiled"
    assert registry._choose("cuda", device, torch.float32) == "cuda"


def test_missing_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "triton", None)
    on_a_gpu = inputs()._replace(means=SimpleNamespace(dtype=torch.float32, device=torch.device("cuda")))
    with pytest.raises(ImportError, match="backend 'cuda' needs Triton: pip install triton"):
        cuda.steps(on_a_gpu)
