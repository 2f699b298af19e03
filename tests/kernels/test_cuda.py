"""The Triton kernel: that it compiles, and refusals; its numbers are in triton_cases.py."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from kcgs.kernels import SplatInputs, cuda, registry

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton is not installed: pip install triton"
)


TYPES = {
    **dict.fromkeys(("counters", "ids", "region_ids", "notes"), "*i64"),
    **dict.fromkeys(("gaussians", "lists", "slots", "pieces", "starts", "regions", "planes"), "*i32"),
    **dict.fromkeys(("means", "cholesky", "colors", "coefficients", "weights", "image", "target", "terms"), "*fp32"),
    **dict.fromkeys(("grad", "means_grad", "cholesky_grad", "colors_grad"), "*fp32"),
    **dict.fromkeys(("radius", "cutoff"), "fp32"),
}


@needs_triton
@pytest.mark.skipif(os.environ.get("TRITON_INTERPRET") == "1", reason="the interpreter does not compile")
def test_compiles_without_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import triton
    from triton.backends.compiler import GPUTarget

    from kcgs.kernels.cuda import gather, plan, render

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    block, map_ = {"BLOCK": render.channels_at_once(32)}, {"MAPPED": True}
    for kernel, constants in (
        (plan._prepare, {**map_, "NOTES": True, "BLOCK": plan._PREPARE_BLOCK}),
        (plan._bin, {"NOTES": True, "BLOCK": plan._BIN_BLOCK}),
        (plan._tile, {**map_, "BLOCK": plan._TILE_BLOCK}),
        (render._render, {**block, **map_, "MINUS": True}),
        (gather._gather, {**block, **map_, "GEOMETRY": True}),
        (gather._reduce, {"GEOMETRY": True, "BLOCK": gather._SLOTS, "COLUMNS": gather._COLUMNS}),
    ):
        signature = {n: "constexpr" if n in constants else TYPES.get(n, "i32") for n in kernel.jit.arg_names}
        source = triton.compiler.ASTSource(kernel.jit, signature, constants)
        compiled = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=kernel.options).asm
        # no sum of values depends on the order in which programs run
        assert not re.search(r"\b(atom|red)\.\S*\.f\d+", compiled["ptx"])
        (tmp_path / "program.ptx").write_text(compiled["ptx"])
        assert "0 bytes spill stores, 0 bytes spill loads" in assemble(tmp_path / "program.ptx")


def assemble(ptx: Path) -> str:
    """Return what the assembler says of registers; Triton brings one, or two of which one knows newer versions."""
    import triton

    folder = Path(triton.__file__).parent / "backends/nvidia/bin"
    target = re.search(r"\.target (\w+)", ptx.read_text())
    assert target is not None
    command = ["-v", f"-arch={target[1]}", ptx, "-o", ptx.with_suffix(".cubin")]
    runs = [subprocess.run([tool, *command], capture_output=True, text=True) for tool in sorted(folder.glob("ptxas*"))]
    return next(run.stderr for run in runs if run.returncode == 0)


def inputs(dtype: torch.dtype = torch.float32) -> SplatInputs:
    arrays = torch.zeros(1, 2, 2, dtype=dtype), torch.ones(1, 2, 3, dtype=dtype), torch.ones(1, 2, 3, dtype=dtype)
    return SplatInputs(*arrays, None, None, (4, 5), 0.0)


@pytest.mark.parametrize(
    ("dtype", "words"),
    [
        (torch.float64, "computes in float32; got torch.float64: use 'tiled'"),
        (torch.float32, "needs tensors on a CUDA device; got cpu"),
    ],
)
def test_exception(dtype: torch.dtype, words: str) -> None:
    with pytest.raises(ValueError, match=f"backend 'cuda' {words}"):
        cuda.kernel_for(inputs(dtype))


@pytest.mark.parametrize("installed", [False, True])
def test_auto(installed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_compiles", lambda _: installed)
    device = torch.device("cuda")
    assert registry._choose("auto", device, torch.float32) == ("cuda" if installed else "tiled")
    assert registry._choose("auto", device, torch.float64) == "tiled"
    assert registry._choose("cuda", device, torch.float32) == "cuda"


def test_missing_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "_has_triton", lambda: False)
    on_a_gpu = inputs()._replace(means=SimpleNamespace(dtype=torch.float32, device=torch.device("cuda")))
    with pytest.raises(ImportError, match="backend 'cuda' needs Triton: pip install triton"):
        cuda.kernel_for(on_a_gpu)


def test_auto_says_why_it_takes_tiled(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no C compiler")

    monkeypatch.setattr(registry, "_splat_once", fail)
    registry._compiles.cache_clear()
    with pytest.warns(UserWarning, match="'auto' takes 'tiled' on cuda, which is slower: RuntimeError: no C compiler"):
        assert registry._choose("auto", torch.device("cuda"), torch.float32) == "tiled"
    assert registry._choose("auto", torch.device("cuda"), torch.float32) == "tiled"  # and does not say it again
    registry._compiles.cache_clear()
