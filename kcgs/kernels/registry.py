"""The kernel of each backend, and of "auto"; the operator in `functional` looks it up here."""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib import import_module

import torch
from torch import Tensor

from kcgs._warn import warn_user
from kcgs.errors import InvalidArgument

from .interface import Kernel, SplatInputs

BACKENDS = ("auto", "reference", "tiled", "cpu", "cuda")


def resolve(backend: str, inputs: SplatInputs) -> Kernel:
    """Return the kernel that `backend` names for these inputs.

    Raises:
        ValueError: inputs that the backend does not take.
    """
    name = _choose(backend, inputs.means.device, inputs.means.dtype)
    return _kernel_for(name)(inputs)


def warm_up(backend: str, device: torch.device, dtype: torch.dtype, channels: int) -> None:
    """Render and differentiate once, before a clock starts, since much is compiled or loaded at first use."""
    image = _splat_once(backend, device, dtype, channels)
    leaf = image.detach().requires_grad_()
    torch.autograd.grad(leaf.sum(), leaf)  # torch, too, loads much at its first gradient


def _splat_once(backend: str, device: torch.device, dtype: torch.dtype, channels: int) -> Tensor:
    """Render and differentiate one Gaussian."""
    means, cholesky, colors = (torch.full((1, 1, n), 8.0, device=device, dtype=dtype) for n in (2, 3, channels))
    inputs = SplatInputs(means, cholesky, colors, None, None, (16, 16), 1e-4)
    kernel = resolve(backend, inputs)
    plan = kernel.plan(inputs)
    image = kernel.render(plan, inputs)
    kernel.differentiate(plan, inputs, torch.ones_like(image), True)
    return image


@functools.cache
def _kernel_for(name: str) -> Callable[[SplatInputs], Kernel]:
    function: Callable[[SplatInputs], Kernel] = import_module(f"{__package__}.{name}").kernel_for
    return function


def _choose(backend: str, device: torch.device, dtype: torch.dtype) -> str:
    if check_backend(backend) != "auto":
        return backend
    if dtype == torch.float32 and (device.type == "cpu" or (device.type == "cuda" and _compiles(device))):
        return device.type
    return "tiled"


@functools.cache
def _compiles(device: torch.device) -> bool:
    """Try the kernel `cuda` on a device, and warn, once, where it cannot be compiled."""
    try:
        _splat_once("cuda", device, torch.float32, 3)
    except Exception as error:  # whatever a compiler, a driver or a card lacks
        is_captured = torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()
        if isinstance(error, torch.OutOfMemoryError) or is_captured:
            raise  # another time it may be compiled
        warn_user(f"backend 'auto' takes 'tiled' on {device}, which is slower: {type(error).__name__}: {error}")
        return False
    return True


def takes_triton(*tensors: Tensor) -> bool:
    """Return whether Triton programs can update these tensors: float32, contiguous, on a device they compile for."""
    return not torch.compiler.is_compiling() and all(
        t.is_cuda and t.dtype is torch.float32 and t.is_contiguous() and _compiles(t.device) for t in tensors
    )


def check_backend(backend: str) -> str:
    """Return `backend`; raise an InvalidArgument if no backend has this name."""
    if backend not in BACKENDS:
        raise InvalidArgument("backend", f"one of {', '.join(BACKENDS)}", repr(backend))
    return backend
