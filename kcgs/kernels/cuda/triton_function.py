"""Triton programs, launched without Triton's search for a variant: that takes the host longer than a GPU needs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import triton
from torch import Tensor


class TritonFunction:
    """A function of tensors, numbers and, last, constants, which is compiled once for each set of these."""

    def __init__(self, function: Any, warps: int) -> None:
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        # multiply and add in one: Triton 3.9 warns where it is not set, and 3.10 will leave it out
        self.options = {"num_warps": warps, "enable_fp_fusion": True}
        # no variants for integers and addresses that are multiples of 16
        self.jit = triton.jit(function, do_not_specialize=[n for n in names if not n.isupper()])
        self._compiled: dict[object, Any] = {}

    def __call__(self, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
        """Run on a grid of programs, on the device of the first argument, which is the present one.

        The constants say which arguments are tensors, and of which type.
        """
        key = arguments[0].device, *constants.values()
        compiled = self._compiled.get(key)
        if compiled is None:
            self._compiled[key] = self.jit[grid](*arguments, **constants, **self.options)
            return
        # for a tensor Triton asks the driver whether its memory is the device's
        values = [a.data_ptr() if isinstance(a, Tensor) else a for a in arguments]
        compiled[(*grid, 1, 1)[:3]](*values, *constants.values())


def triton_function(warps: int) -> Callable[[Any], TritonFunction]:
    """Decorate a function of Triton's, whose programs have so many warps, of 32 threads each."""
    return lambda function: TritonFunction(function, warps)


@functools.cache
def is_interpreted() -> bool:
    """Whether TRITON_INTERPRET=1 was set when triton was imported: programs run in numpy, on CPU tensors."""
    return not isinstance(triton.jit(triton_function), triton.JITFunction)
