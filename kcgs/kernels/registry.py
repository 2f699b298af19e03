"""What each backend name means, and what "auto" picks."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from importlib import import_module, util
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .autograd import SplatInputs

if TYPE_CHECKING:  # loads numba
    from .compiled import Program

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
    name = _choose(backend, device, dtype)
    return functools.partial(_untraced if torch.compiler.is_compiling() else _splat, name)


def _choose(backend: str, device: torch.device, dtype: torch.dtype) -> str:
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    if backend != "auto":
        return backend
    runs = device.type == "cpu" or (device.type == "cuda" and _has_triton())
    return device.type if runs and dtype == torch.float32 else "tiled"


def compile_ahead(backend: str) -> list[Program]:
    """Begin to compile, in other processes, what float32 images on the CPU need of a backend."""
    name = _choose(backend, torch.device("cpu"), torch.float32)
    return [import_module(f"{__package__}.cpu.loops").program.start()] if name == "cpu" else []


@functools.cache
def prepare(backend: str, device: torch.device, dtype: torch.dtype, channels: int) -> None:
    """Render and differentiate once, so that no clock counts what compiles or loads at first use."""
    means, cholesky, colors = (
        torch.full((1, 1, n), 8.0, device=device, dtype=dtype, requires_grad=True) for n in (2, 3, channels)
    )
    image = resolve(backend, device, dtype)(SplatInputs(means, cholesky, colors, None, None, (16, 16), 1e-4))
    torch.autograd.grad(image, means, torch.ones_like(image))  # torch too loads much at the first gradient


def _splat(name: str, inputs: SplatInputs) -> Tensor:
    image: Tensor = import_module(f"{__package__}.{name}").splat(inputs)
    return image


@torch._disable_dynamo  # type: ignore[attr-defined]  # the public name imports the compiler
def _untraced(name: str, inputs: SplatInputs) -> Tensor:
    """Render outside of the compiled graph: the compiler would trace into numba and Triton."""
    return _splat(name, inputs)
