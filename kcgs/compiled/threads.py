"""Number of threads of the CPU kernel, which may be more than torch's own operations have."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Concatenate, ParamSpec, TypeVar

import torch
from torch import Tensor

# pixels of an image: above this number torch's operations gain more from threads than waiting costs
_MAX_PIXELS = 1 << 21

P = ParamSpec("P")
R = TypeVar("R")

_num_threads: ContextVar[int | None] = ContextVar("threads of the kernels", default=None)


def num_threads() -> int:
    """Return torch's number of threads; within `threads_for_kernels`, the number that torch had outside."""
    return _num_threads.get() or torch.get_num_threads()


@contextmanager
def threads_for_kernels(pixels: int) -> Iterator[None]:
    """Give all threads to the kernels and one to torch; on an image of over two million pixels torch keeps its own.

    Torch's threads wait for each other by spinning. Where other programs run on the machine, waiting takes ten times as
    long as short operations themselves.
    """
    before = torch.get_num_threads()
    if pixels > _MAX_PIXELS or before == 1:
        yield
        return
    token = _num_threads.set(num_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _num_threads.reset(token)


def image_threads_for_kernels(function: Callable[Concatenate[Tensor, P], R]) -> Callable[Concatenate[Tensor, P], R]:
    """Decorate a function of an image, (..., H, W), to run within :func:`threads_for_kernels`."""

    @functools.wraps(function)
    def run(image: Tensor, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with threads_for_kernels(image.shape[-2] * image.shape[-1]):
            return function(image, *args, **kwargs)

    return run
