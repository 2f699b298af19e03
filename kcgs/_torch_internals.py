"""The private names of torch that kcgs uses, each in one function that says what it is for.

`tests/test_private_names.py` lists them with what breaks where torch has one no longer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor
from torch._C._functorch import get_unwrapped, is_functorch_wrapped_tensor, is_legacy_batchedtensor
from torch._functorch.utils import enable_single_level_autograd_function
from torch.autograd import forward_ad


def assert_async(condition: Tensor, message: str) -> None:
    """Raise RuntimeError where a 0-dim tensor is false, on CUDA without a host sync, and as a node of a graph."""
    torch._assert_async(condition, message)


def unwrapped(tensor: Tensor) -> Tensor:
    """Return the tensor inside of the wrappers of `torch.func`: vmap has no rule for assertions."""
    while is_functorch_wrapped_tensor(tensor):
        tensor = get_unwrapped(tensor)
    return tensor


def below_autograd(function: Any, *arguments: Any) -> Any:
    """Call a function without autograd; else an operator that its own autograd kernel calls would call that again."""
    with torch._C._AutoDispatchBelowAutograd():
        return function(*arguments)


@contextmanager
def with_autograd() -> Iterator[None]:
    """Record a graph inside of an operator; else nothing would be, since operators are evaluated below autograd."""
    keys = torch._C.DispatchKey.AutogradFunctionality, torch._C.DispatchKey.ADInplaceOrView
    with ExitStack() as stack:
        for key in keys:
            stack.enter_context(torch._C._SetExcludeDispatchKeyGuard(key, False))
        stack.enter_context(torch.enable_grad())
        yield


def is_transforming() -> bool:
    """True inside of `torch.func`; else a kernel would read the wrappers that vmap and jvp put around tensors."""
    return bool(torch._C._are_functorch_transforms_active())


def has_mode() -> bool:
    """True under a mode, fake tensors or a counter of operations; else the mode would not see the operator."""
    return bool(torch._C._len_torch_dispatch_stack())


def is_batched_gradient(tensor: Tensor) -> bool:
    """True for gradients of `is_grads_batched`, wrappers of an older kind; else a kernel would read them."""
    return bool(is_legacy_batchedtensor(tensor))


def is_forward_mode() -> bool:
    """True inside of `forward_ad.dual_level`; else tensors that need no gradient would lose their tangents."""
    return forward_ad._current_level >= 0


def forward_derivatives() -> Any:
    """Take forward derivatives inside of the forward of an autograd.Function; else outer levels of `jvp` would be 0."""
    return forward_ad._set_fwd_grad_enabled(True)


def is_graph_retained() -> bool:
    """True in a backward with `retain_graph`; else a loss that stays alive would hold the memory of a plan."""
    return bool(torch._C._autograd._get_current_graph_task_keep_graph())


def apply(function: Any, *arguments: Any) -> Any:
    """Apply an autograd.Function; else torch refuses one whose forward takes `ctx` inside of `torch.func`.

    It may, since its forward calls an operator that transforms see.
    """
    if is_transforming():
        with enable_single_level_autograd_function():
            return super(torch.autograd.Function, function).apply(*arguments)
    return super(torch.autograd.Function, function).apply(*arguments)


def register_decomposition(operator: Any, function: Any, kind: str = "post_autograd") -> None:
    """Give `torch.onnx.export` standard operators, or fake tensors of open sizes a shape (`kind` "meta").

    Else the first has no translation of the operator, and the second decompose it.
    """
    torch._decomp.register_decomposition(operator, type=kind)(function)
