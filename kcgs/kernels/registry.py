"""What each backend name means, and what "auto" picks."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import torch
from torch import Tensor

from .inputs import SplatInputs

BACKENDS = ("auto", "reference", "tiled", "cpu")

Kernel = Callable[[SplatInputs], Tensor]


def resolve(backend: str, device: torch.device, dtype: torch.dtype) -> Kernel:
    """Return the kernel that `backend` names for tensors of this device and dtype.

    Raises:
        ValueError: unknown name.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    name = backend
    if backend == "auto":
        name = "cpu" if device.type == "cpu" and dtype == torch.float32 else "tiled"
    kernel: Kernel = import_module(f"{__package__}.{name}").splat
    return kernel
