"""Triton programs, launched without Triton's search for a variant, which takes longer than the program on the GPU."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import triton
from torch import Tensor


class TritonFunction:
    """A Triton program of tensors, numbers and, last, constants; it is compiled per device and set of constants."""

    def __init__(self, function: Any, warps: int) -> None:
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        # fuse multiply and add: Triton 3.9 warns if the option is not set, and 3.10 will no longer fuse by default
        self.options = {"num_warps": warps, "enable_fp_fusion": True}
        # no variants for integers and addresses that are multiples of 16
        self.jit = triton.jit(function, do_not_specialize=[n for n in names if not n.isupper()])
        self._compiled: dict[object, Any] = {}

    def __call__(self, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
        """Run a grid of programs on the device of the first argument, which must be the current device.

        The constants determine which arguments are tensors, and their dtypes.
        """
        key = arguments[0].device, *constants.values()
        compiled = self._compiled.get(key)
        if compiled is None:
            self._compiled[key] = self.jit[grid](*arguments, **constants, **self.options)
            return
        # addresses, since Triton asks the driver of every tensor whether its memory is on the device
        values = [a.data_ptr() if isinstance(a, Tensor) else a for a in arguments]
        compiled[(*grid, 1, 1)[:3]](*values, *constants.values())


def triton_function(warps: int) -> Callable[[Any], TritonFunction]:
    """Decorate a Triton function; each program has so many warps, of 32 threads each."""
    return lambda function: TritonFunction(function, warps)


@functools.cache
def is_interpreted() -> bool:
    """Return whether TRITON_INTERPRET=1 was set when triton was imported: programs run in numpy, on CPU tensors."""
    return not isinstance(triton.jit(triton_function), triton.JITFunction)
