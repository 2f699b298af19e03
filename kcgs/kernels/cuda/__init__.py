"""The kernel `cuda`: six Triton programs, float32, which plan, render and differentiate on the device.

`plan` finds the Gaussians of every tile, `render` sums them at its pixels, `gather` differentiates. Atomic additions
reserve the memory of lists, but compute no sum: each sum has one owner and one order, so results repeat bit for bit.
"""

from __future__ import annotations

import functools
from importlib.util import find_spec

import torch

from ..interface import Kernel, SplatInputs


@functools.cache
def _has_triton() -> bool:
    return find_spec("triton") is not None


def kernel_for(inputs: SplatInputs) -> Kernel:
    """Return the kernel; raise where it does not take the inputs, or Triton is missing."""
    dtype, device = inputs.means.dtype, inputs.means.device
    if dtype != torch.float32:
        raise ValueError(f"backend 'cuda' computes in float32; got {dtype}: use 'tiled' or 'reference'")
    if device.type != "cuda" and not _is_interpreted():
        raise ValueError(f"backend 'cuda' needs tensors on a CUDA device; got {device}")
    if not _has_triton():
        raise ImportError("backend 'cuda' needs Triton: pip install triton")
    return _kernel()


@functools.cache
def _kernel() -> Kernel:
    from .gather import differentiate, error_gradients
    from .plan import plan
    from .render import render

    return Kernel(
        plan,
        render,
        differentiate,
        error_gradients=error_gradients,
        checks_values=True,
        takes_one_image=True,
        looks_up_regions=True,
    )


def _is_interpreted() -> bool:
    if not _has_triton():
        return False
    from .triton_function import is_interpreted

    return is_interpreted()
