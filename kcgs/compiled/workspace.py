"""Memory that a thread keeps from one call to the next."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

_ALIGNMENT = 64
# size of a new block over the size that was needed: a fit that adds Gaussians needs a little more from call to call
_GROWTH = 1.25


class Workspace:
    """Memory for the arrays of one call; a later call of the same Python thread takes it over, one at a time.

    The C library may return freed memory to the system, which clears each page when it is used again: up to 4 ms per
    render. An array must not be used after its workspace is gone.
    """

    def __init__(self) -> None:
        self._home = _kept.spares
        self._block = self._home.pop() if self._home else np.empty(0, np.uint8)
        self._used = self._most = 0
        self._is_lent = threading.Lock()

    def __del__(self) -> None:
        block = self._block
        if self._most > len(block):
            block = np.empty(int(self._most * _GROWTH), np.uint8)
        if not self._home or len(self._home[0]) < len(block):
            self._home[:] = [block]

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Return an array without values; where the block is too short, in memory of its own."""
        size = math.prod(shape if isinstance(shape, tuple) else (shape,)) * np.dtype(dtype).itemsize
        start = self._used
        self._used += -(-size // _ALIGNMENT) * _ALIGNMENT
        self._most = max(self._most, self._used)
        if self._used > len(self._block):
            return np.empty(shape, dtype)
        return np.ndarray(shape, dtype, self._block, start)

    @contextmanager
    def rest(self) -> Iterator[Workspace]:
        """Lend the memory behind the present arrays to one borrower at a time; others get their own workspace."""
        if not self._is_lent.acquire(blocking=False):
            yield Workspace()
            return
        used = self._used
        try:
            yield self
        finally:
            self._used = used
            self._is_lent.release()


def borrowed(array: Any) -> Any:
    """Return a view of a contiguous array, for `run_tasks`, that does not keep its memory alive.

    A thread holds its arguments a moment longer than it works on them: the caller's next array would get new memory.
    """
    if array.nbytes == 0:
        return array
    return np.ndarray(array.shape, array.dtype, (ctypes.c_byte * array.nbytes).from_address(array.ctypes.data))


class _Kept(threading.local):
    """What a thread keeps between calls: a block, or nothing."""

    def __init__(self) -> None:
        self.spares: list[Any] = []


_kept = _Kept()
