"""The Triton kernel: refusals here; numbers in triton_cases.py, run in processes of their own.

TRITON_INTERPRET is read when triton is imported, so it must not be set in the process of the other tests.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from kcgs.kernels import SplatInputs, cuda

CASES = Path(__file__).with_name("triton_cases.py")

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton is not installed: pip install triton"
)


def run_cases(chosen: str, interpret: bool) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    if interpret:
        environment |= {"TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", chosen, str(CASES)]
    root = CASES.parent.parent.parent
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout and " skipped" not in done.stdout, done.stdout


@needs_triton
def test_agrees_with_the_reference() -> None:
    run_cases("not compiles", interpret=not torch.cuda.is_available())


@needs_triton
def test_compiles_without_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    run_cases("compiles", interpret=False)


def inputs(dtype: torch.dtype = torch.float32) -> SplatInputs:
    arrays = torch.zeros(1, 2, 2, dtype=dtype), torch.ones(1, 2, 3, dtype=dtype), torch.ones(1, 2, 3, dtype=dtype)
    return SplatInputs(*arrays, None, None, (4, 5), 0.0)


def test_float64_is_refused() -> None:
    with pytest.raises(ValueError, match="backend 'cuda' computes in float32; got torch.float64: use 'tiled'"):
        cuda.splat(inputs(torch.float64))


def test_cpu_is_refused() -> None:
    with pytest.raises(ValueError, match="backend 'cuda' needs tensors on a CUDA device; got cpu"):
        cuda.splat(inputs())


def test_missing_triton_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "triton", None)
    on_a_gpu = inputs()._replace(means=SimpleNamespace(dtype=torch.float32, device=torch.device("cuda")))
    with pytest.raises(ImportError, match="backend 'cuda' needs Triton: pip install triton"):
        cuda.splat(on_a_gpu)
