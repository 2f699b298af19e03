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
        runs = device.type == "cpu" or (device.type == "cuda" and _has_triton())
        name = device.type if runs and dtype == torch.float32 else "tiled"
    return functools.partial(_untraced if torch.compiler.is_compiling() else _splat, name)


def _splat(name: str, inputs: SplatInputs) -> Tensor:
    image: Tensor = import_module(f"{__package__}.{name}").splat(inputs)
    return image


@torch._disable_dynamo  # type: ignore[attr-defined]  # the public name imports the compiler
def _untraced(name: str, inputs: SplatInputs) -> Tensor:
    """Render outside of the compiled graph: the compiler would trace into numba and Triton."""
    return _splat(name, inputs)
