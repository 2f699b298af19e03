"""Integer constants in few bytes, and the operators that unfold them to int32 on loading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .graph import INT32, Graph, Value

# bytes of the operators that unfold a sparse constant, which must save more than this
_SPARSE_COST = 500


def pack_integers(g: Graph, numbers: NDArray[np.int64]) -> Value:
    """Store integers of 0 or more in one, two or four bytes each.

    Two bytes are stored as two arrays, low and high bytes: some runtimes have no 16-bit types.
    """
    largest = int(numbers.max(initial=0))
    if largest >= 1 << 16:
        return g.constant(numbers.astype(np.int32))
    low = g.constant((numbers % 256).astype(np.uint8)).astype(INT32)
    if largest < 256:
        return low
    high = g.constant((numbers // 256).astype(np.uint8)).astype(INT32)
    return low + high * 256


def pack_sparse(g: Graph, numbers: NDArray[np.int64]) -> Value:
    """Store integers (n,) that are mostly 0: a flag for each, and the numbers that are not 0."""
    used = numbers > 0
    size = 1 if numbers.max(initial=0) < 256 else 2
    if size * used.sum() + len(numbers) // 8 + _SPARSE_COST > size * len(numbers):
        return pack_integers(g, numbers)
    flags = pack_flags(g, used)
    values = g.Concat(np.zeros(1, np.int32), pack_integers(g, numbers[used]), axis=0)
    return values[flags * g.CumSum(flags, 0)]


def pack_flags(g: Graph, flags: NDArray[np.bool_]) -> Value:
    """Store flags (n,) as bits; bytes of bits are stored sparsely if few flags are set."""
    octets = pack_sparse(g, np.packbits(flags, bitorder="little").astype(np.int64))
    bits = g.Unsqueeze(octets, [1]) // (1 << np.arange(8)).astype(np.int32)
    return g.Slice(g.Reshape(bits % 2, [-1]), [0], [len(flags)], [0])


def pack_runs(g: Graph, numbers: NDArray[np.int64]) -> Value:
    """Store integers (n,) that often equal the integer before: flags of changes, and the new numbers."""
    changes = np.diff(numbers, prepend=-1) != 0
    run = g.CumSum(pack_flags(g, changes), 0) - 1
    return pack_integers(g, numbers[changes])[run]
