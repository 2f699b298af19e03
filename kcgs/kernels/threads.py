"""How many threads the kernels take, which may be more than torch's own operations get."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Concatenate, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")

_kernels: ContextVar[int | None] = ContextVar("threads of the kernels", default=None)


def num_threads() -> int:
    """Return torch's number of threads, or what it was where the kernels have them to themselves."""
    return _kernels.get() or torch.get_num_threads()


@contextmanager
def threads_for_kernels(pixels: int, most: int = 1 << 21) -> Iterator[None]:
    """Give all threads to the kernels meanwhile, and one to torch; on images above `most` pixels torch keeps its own.

    Torch's threads wait for each other by spinning. Where other programs run beside it, and its operations are short,
    that takes ten times as long as they do.
    """
    before = torch.get_num_threads()
    if pixels > most or before == 1:
        yield
        return
    token = _kernels.set(num_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _kernels.reset(token)


def image_threads_for_kernels(function: Callable[Concatenate[Tensor, P], R]) -> Callable[Concatenate[Tensor, P], R]:
    """Decorate a function of an image, (..., H, W), to run as :func:`threads_for_kernels` has it."""

    @functools.wraps(function)
    def run(image: Tensor, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with threads_for_kernels(image.shape[-2] * image.shape[-1]):
            return function(image, *args, **kwargs)

    return run
