"""The private names of torch that kcgs uses, each in one function that says what it is for.

`tests/test_private_names.py` lists each name, and what breaks if torch removes it.
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
    """Call a function without autograd, so that an operator's own autograd kernel can call the operator."""
    with torch._C._AutoDispatchBelowAutograd():
        return function(*arguments)


@contextmanager
def with_autograd() -> Iterator[None]:
    """Record a graph inside of an operator, although operators are evaluated below autograd."""
    keys = torch._C.DispatchKey.AutogradFunctionality, torch._C.DispatchKey.ADInplaceOrView
    with ExitStack() as stack:
        for key in keys:
            stack.enter_context(torch._C._SetExcludeDispatchKeyGuard(key, False))
        stack.enter_context(torch.enable_grad())
        yield


def is_transforming() -> bool:
    """Return whether `torch.func` is active: a kernel must not read the wrappers of tensors in vmap and jvp."""
    return bool(torch._C._are_functorch_transforms_active())


def has_mode() -> bool:
    """Return whether a mode is active, such as fake tensors or a counter of operations: it must see the operator."""
    return bool(torch._C._len_torch_dispatch_stack())


def is_batched_gradient(tensor: Tensor) -> bool:
    """Return whether a gradient is an older wrapper, of `is_grads_batched`, which a kernel must not read."""
    return bool(is_legacy_batchedtensor(tensor))


def is_forward_mode() -> bool:
    """Return whether `forward_ad.dual_level` is active, where tensors that need no gradient may have tangents."""
    return forward_ad._current_level >= 0


def forward_derivatives() -> Any:
    """Take forward derivatives inside of an autograd.Function's forward; without them outer levels of `jvp` are 0."""
    return forward_ad._set_fwd_grad_enabled(True)


def is_graph_retained() -> bool:
    """Return whether the present backward has `retain_graph`: if not, the memory of a plan is freed."""
    return bool(torch._C._autograd._get_current_graph_task_keep_graph())


def differentiate(output: Tensor, inputs: tuple[Tensor, ...], gradient: Tensor) -> tuple[Tensor, ...]:
    """Call `torch.autograd.grad` without its check of the gradient's shape, which imports sympy."""
    return torch.autograd.graph._engine_run_backward(
        (output,), (gradient,), False, False, inputs, False, accumulate_grad=False
    )


def apply(function: Any, *arguments: Any) -> Any:
    """Apply an autograd.Function whose forward takes `ctx`, which torch refuses inside of `torch.func`.

    It is safe there, since the forward calls an operator that transforms see.
    """
    if is_transforming():
        with enable_single_level_autograd_function():
            return super(torch.autograd.Function, function).apply(*arguments)
    return super(torch.autograd.Function, function).apply(*arguments)


def register_decomposition(operator: Any, function: Any, kind: str = "post_autograd") -> None:
    """Register standard operators for `torch.onnx.export`, or, with `kind` "meta", a shape for open sizes.

    Without the first, the export has no translation of the operator; without the second, fake tensors decompose it.
    """
    torch._decomp.register_decomposition(operator, type=kind)(function)
