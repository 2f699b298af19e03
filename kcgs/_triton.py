"""Triton, which compiles kernels for CUDA, and is not everywhere."""

from __future__ import annotations

import functools
from importlib.util import find_spec

import torch
from torch import Tensor


@functools.cache
def has_triton() -> bool:
    """True where Triton is installed."""
    return find_spec("triton") is not None


def takes_triton(*tensors: Tensor) -> bool:
    """True where a kernel of Triton for float32 may read and change the memory of tensors."""
    return (
        not torch.compiler.is_compiling()
        and all(t.is_cuda and t.dtype is torch.float32 and t.is_contiguous() for t in tensors)
        and has_triton()
    )
