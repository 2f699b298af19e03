"""The most that this processor could do: the arithmetic of the CPU kernel with nothing read and nothing written.

The loops are those of the kernel (`kcgs.kernels.cpu.simd`), with the pixels' loads and stores left out.
"""

from __future__ import annotations

import time
from threading import Thread
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from kcgs.kernels import SplatInputs
from kcgs.kernels.cpu import simd
from kcgs.kernels.cpu.kernel import plan
from kcgs.kernels.cpu.loops import _enter_tile, _find_mask
from kcgs.kernels.cpu.simd import SIDE

from .workloads import Workload

_CHANNELS = 3


def _registers(context: Any, builder: Any, signature: Any, arguments: Any, backward: bool) -> Any:
    start = ir.Constant(ir.IntType(64), 0)
    coefficients = simd._pointer(context, builder, signature.args[1], arguments[1], start)
    geometry = simd._Columns(builder, coefficients, arguments[2])
    color = simd._constant(0.5)
    count = _CHANNELS + 3 if backward else _CHANNELS
    row, sums, close = simd._rows(builder, start, arguments[0], [simd._constant(0.0)] * count)
    second, weight = geometry.weight(simd._middle(builder, builder.urem(row, ir.Constant(row.type, SIDE))), None)
    following = [simd._call(builder, "fma", weight, color, total) for total in sums[:_CHANNELS]]
    if backward:
        value = builder.fmul(color, color)
        for _ in range(_CHANNELS - 1):
            value = simd._call(builder, "fma", weight, color, value)
        value = builder.fmul(value, weight)
        moment = builder.fmul(value, second)
        total, along, square = sums[_CHANNELS:]
        following += [builder.fadd(total, value), builder.fadd(along, moment)]
        following.append(simd._call(builder, "fma", moment, second, square))
    out = close(following)
    mixed = out[0]
    for value in out[1:]:
        mixed = builder.fadd(mixed, value)
    return builder.extract_element(mixed, ir.Constant(ir.IntType(32), 0))


@intrinsic
def _forward(typing_context, rows, coefficients, lowest):  # type: ignore[no-untyped-def]
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _registers(context, builder, signature, arguments, False)

    return types.float32(types.int64, coefficients, types.float32), generate


@intrinsic
def _backward(typing_context, rows, coefficients, lowest):  # type: ignore[no-untyped-def]
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _registers(context, builder, signature, arguments, True)

    return types.float32(types.int64, coefficients, types.float32), generate


@njit(nogil=True)
def _spin(rows, coefficients, lowest, backward):  # type: ignore[no-untyped-def]
    return _backward(rows, coefficients, lowest) if backward else _forward(rows, coefficients, lowest)  # type: ignore[call-arg]


def seconds_for(pairs: float, *, backward: bool, threads: int = 1) -> float:
    """Measure how long this many (pixel, Gaussian) pairs take in registers; on two threads, half each."""
    coefficients = np.array([0.1, 0.01, 0.1, 0.01, 0.02], np.float32)
    rows = round(pairs / SIDE / threads)

    def spin() -> None:
        _spin(rows, coefficients, np.float32(-20.0), backward)

    others = [Thread(target=spin) for _ in range(threads - 1)]
    start = time.perf_counter()
    for other in others:
        other.start()
    spin()
    for other in others:
        other.join()
    return time.perf_counter() - start


@njit
def _rows_visited(lists, height, width):  # type: ignore[no-untyped-def]
    rows, cols = -(-height // SIDE), -(-width // SIDE)
    coefficients = np.empty(5, np.float32)
    total = 0
    for row in range(rows):
        for e in range(lists.start[row], lists.start[row + 1]):
            i = lists.entries[e, 0]
            for col in range(lists.entries[e, 1], lists.entries[e, 2]):
                if lists.num_regions > 0 and not _find_mask(lists, row * cols + col, lists.regions[i])[1]:
                    continue
                first, last = _enter_tile(lists.gaussians[i], row, col, height, width, lists.radius, coefficients)
                total += max(0, last - first)
    return total


def evaluated_pairs(scene: Workload, cutoff: float) -> int:
    """Count the (pixel, Gaussian) pairs that the CPU kernel evaluates: whole rows of 16 pixels."""
    membership, size = scene.regions.membership, scene.regions.size
    index = scene.regions.index_of(scene.region_ids)[None]
    inputs = SplatInputs(scene.means[None], scene.cholesky[None], scene.colors[None], index, membership, size, cutoff)
    return int(_rows_visited(plan(inputs).lists, *size)) * SIDE
