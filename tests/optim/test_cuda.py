"""The kernel of GaussianAdam: that it compiles; its steps are in triton_steps.py."""

from __future__ import annotations

import importlib.util
import os
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton is not installed: pip install triton"
)


NUMBERS = {
    *("beta1", "beta2", "eps", "color_beta1", "color_beta2", "color_eps"),
    *("max_step", "height", "width", "max_factor", "min_sigma", "min_factor", "max_outside"),
}


@pytest.mark.skipif(os.environ.get("TRITON_INTERPRET") == "1", reason="the interpreter does not compile")
@pytest.mark.parametrize(("capability", "opacities", "rate"), [(80, False, "fp32"), (90, True, "*fp32")])
def test_compiles_without_a_gpu(
    capability: int, opacities: bool, rate: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import triton
    from triton.backends.compiler import GPUTarget

    from kcgs.optim import cuda

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    constants = {"CHANNELS": 3, "COLUMNS": 3 + opacities, "MEANS": True, "CHOLESKY": True, "COLORS": True}
    constants |= {"OPACITIES": opacities, "LR_LOADED": rate == "*fp32", "COLOR_LR_LOADED": rate == "*fp32"}
    types = {**dict.fromkeys(NUMBERS, "fp32"), **dict.fromkeys(("lr", "color_lr"), rate), "count": "i32"}
    types |= dict.fromkeys(constants, "constexpr")
    signature = {name: types.get(name, "*fp32") for name in cuda._step.jit.arg_names}
    source = triton.compiler.ASTSource(cuda._step.jit, signature, constants)
    ptx = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=cuda._step.options).asm["ptx"]
    assert "sqrt.rn.f64" in ptx
    # no Gaussian knows of another
    assert not re.search(r"\b(atom|red|shfl|bar)\.", ptx)
