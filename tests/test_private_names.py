"""Private names of torch and numba: each stands in one module, and an upgrade that removes one says what breaks."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

import kcgs

PACKAGE = Path(kcgs.__file__).parent
# what breaks without a name
TORCH = {
    "torch._assert_async": "checks of values in graphs and on CUDA",
    "torch._C._functorch.is_functorch_wrapped_tensor": "checks of values under torch.func.vmap",
    "torch._C._functorch.get_unwrapped": "checks of values under torch.func.vmap",
    "torch._C._AutoDispatchBelowAutograd": "gradients of region_splat",
    "torch._C.DispatchKey.AutogradFunctionality": "gradients of backends 'tiled' and 'reference'",
    "torch._C.DispatchKey.ADInplaceOrView": "gradients of backends 'tiled' and 'reference'",
    "torch._C._SetExcludeDispatchKeyGuard": "gradients of backends 'tiled' and 'reference'",
    "torch._C._are_functorch_transforms_active": "region_splat under torch.func",
    "torch._functorch.utils.enable_single_level_autograd_function": "region_splat under torch.func",
    "torch._C._len_torch_dispatch_stack": "region_splat under torch.compile, torch.export and counters of operations",
    "torch._C._functorch.is_legacy_batchedtensor": "torch.autograd.grad of region_splat with is_grads_batched",
    "torch.autograd.forward_ad._current_level": "forward derivatives of region_splat",
    "torch.autograd.forward_ad._set_fwd_grad_enabled": "nested forward derivatives of region_splat",
    "torch.autograd.graph._engine_run_backward": "gradients of objectives in a fit",
    "torch._C._autograd._get_current_graph_task_keep_graph": "backward of region_splat with retain_graph",
    "torch._decomp.register_decomposition": "torch.onnx.export of a renderer",
}
NUMBA = {
    "numba.core.cgutils.for_range": "the vector code of the CPU kernel",
    "numba.core.cgutils.for_range_slice": "the vector code of the CPU kernel",
    "numba.core.cgutils.alloca_once": "the vector code of the CPU kernel",
    "numba.core.cgutils.alloca_once_value": "the vector code of the CPU kernel",
    "numba.core.cgutils.get_or_insert_function": "threads of compiled loops",
    "numba.core.config.CACHE_DIR": "NUMBA_CACHE_DIR as the folder of compiled loops",
    "numba.core.caching.NullCache": "compiled loops that are kept on disk",
    "numba.core.compiler.CompileResult._rebuild": "compiled loops that are kept on disk",
    "numba.core.compiler.CompileResult._reduce": "compiled loops that are kept on disk",
    "numba.core.serialize.dumps": "compiled loops that are kept on disk",
    "numba.core.dispatcher.Dispatcher._cache": "compiled loops that are kept on disk",
    "numba.misc.appdirs.AppDirs.user_cache_dir": "the user's folder of compiled loops",
}


def resolve(name: str) -> object:
    """Return what a dotted name stands for: an attribute of its longest part that is a module."""
    parts = name.split(".")
    thing: object = None
    for k, part in enumerate(parts):
        try:
            thing = importlib.import_module(".".join(parts[: k + 1]))
        except ImportError:
            thing = getattr(thing, part)
    return thing


@pytest.mark.parametrize("name", [*TORCH, *NUMBA])
def test_exists(name: str) -> None:
    if name.endswith("Dispatcher._cache"):  # of an instance
        import numba

        assert hasattr(numba.njit(lambda: None), "_cache"), f"{(TORCH | NUMBA)[name]}: there is no {name}"
        return
    try:
        resolve(name)
    except AttributeError:
        pytest.fail(f"{(TORCH | NUMBA)[name]}: there is no {name}")


@pytest.mark.parametrize(
    ("pattern", "home", "names"),
    [
        (r"\btorch(?:\.\w+)*\._\w+(?:\.\w+)*|\bforward_ad\._\w+", "_torch_internals", TORCH),
        (r"\bnumba\.(?:core|misc)[.\w]*|\bcgutils\.\w+|\._(?:rebuild|reduce)\b", "_numba_internals", NUMBA),
    ],
)
def test_stand_in_one_module(pattern: str, home: str, names: dict[str, str]) -> None:
    for path in PACKAGE.rglob("*.py"):
        for used in set(re.findall(pattern, path.read_text())):
            assert path.stem == home or used.startswith("cgutils."), f"{path}: {used}"
            assert any(used in name for name in names), f"{path}: {used} is not listed here"
