"""What each backend name means, and what "auto" picks."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from importlib import import_module, util

import torch
from torch import Tensor

from .autograd import SplatInputs

BACKENDS = ("auto", "reference", "tiled", "cpu", "cuda")

Kernel = Callable[[SplatInputs], Tensor]


def _runs(device: str) -> bool:
    return device == "cpu" or (device == "cuda" and _has_triton())


@functools.cache
def _has_triton() -> bool:
    if util.find_spec("triton") is not None:
        return True
    warnings.warn(
        "Triton is not installed: rendering on CUDA takes the slower 'tiled' (pip install triton)", stacklevel=2
    )
    return False


def resolve(backend: str, device: torch.device, dtype: torch.dtype) -> Kernel:
    """Return the kernel that `backend` names for tensors of this device and dtype.

    Raises:
        ValueError: unknown name.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    name = backend
    if backend == "auto":
        name = device.type if dtype == torch.float32 and _runs(device.type) else "tiled"
    if torch.compiler.is_compiling():
        return functools.partial(_untraced, name)
    return _kernel(name)


def _kernel(name: str) -> Kernel:
    kernel: Kernel = import_module(f"{__package__}.{name}").splat
    return kernel


@torch._disable_dynamo  # type: ignore[attr-defined]  # the public name imports the compiler
def _untraced(name: str, inputs: SplatInputs) -> Tensor:
    """Render outside of the compiled graph: the compiler would trace into numba and Triton."""
    return _kernel(name)(inputs)
