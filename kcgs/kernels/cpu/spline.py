"""Vector code from a coarse grid to one of half its spacing, and back, in blocks of 16 x 16.

Along an axis, values 2 i and 2 i + 1 of the finer grid are each a sum of four neighbours, i ... i + 3, of a window of
the coarser one, which begins at a block's first node or in its middle. Blocks lie in memory as [row][channel][column].
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .simd import FLOAT, LONG, SIDE, UNDEFINED, VECTOR, ZERO, apply, constant, if_else, load, pointer, shuffle, store

# weights of the four neighbours of values 2 i and 2 i + 1: the exact refinement of cubic B-splines
_REFINE_EVEN = (0.5, 0.5, 0.0, 0.0)
_REFINE_ODD = (0.125, 0.75, 0.125, 0.0)
# cubic B-splines at pixel centres, a quarter and three quarters of the way from one node to the next
_SAMPLE_EVEN = (27 / 384, 235 / 384, 121 / 384, 1 / 384)
_SAMPLE_ODD = (1 / 384, 121 / 384, 235 / 384, 27 / 384)

# nodes of the coarser grid within a block, along an axis
_HALF = SIDE // 2
# nodes of the coarser grid that a block reads, along an axis
_WINDOW = _HALF + 3
# elements of two vectors: the last half of the first and the first half of the second
_MIDDLE = range(_HALF, _HALF + SIDE)


def _long(value: int) -> ir.Constant:
    return ir.Constant(LONG, value)


def _multiply_add(builder: Any, factor: float, value: Any, total: Any) -> Any:
    if factor == 0.0:
        return total
    return (
        builder.fmul(constant(factor), value)
        if total is None
        else apply(builder, "fma", constant(factor), value, total)
    )


def _alternating(even: float, odd: float) -> ir.Constant:
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, float(v)) for _ in range(_HALF) for v in (even, odd)])


class _Blocks:
    """A block of the finer grid and the four of the coarser one that it reads, as LLVM values."""

    def __init__(self, context: Any, builder: Any, argument_types: Any, arguments: Any) -> None:
        self.builder = builder
        self.down, self.right = arguments[2:4]
        table = pointer(context, builder, argument_types[1], arguments[1], ZERO)
        offsets = [builder.load(builder.gep(table, [_long(k)])) for k in range(4)]
        self.parents = [pointer(context, builder, argument_types[0], arguments[0], offset) for offset in offsets]
        self.fine = pointer(context, builder, argument_types[4], arguments[4], arguments[5])
        self.row_stride, self.channel_stride, self.channels = arguments[6:9]
        self.masks = pointer(context, builder, argument_types[9], arguments[9], arguments[10])
        self.mask_stride = arguments[11]

    def fine_row(self, channel: Any, row: int) -> Any:
        """Return the pointer to a row of the finer block."""
        builder = self.builder
        place = builder.mul(channel, self.channel_stride)
        return builder.gep(self.fine, [builder.add(place, builder.mul(self.row_stride, _long(row)))])

    def mask(self, row: int) -> Any:
        """Return the weights of a row."""
        return load(self.builder, self.builder.gep(self.masks, [self.builder.mul(self.mask_stride, _long(row))]))

    def window_row(self, channel: Any, row: int) -> tuple[Any, Any]:
        """Return the pointers to a row of the window, in the left block and in the right one."""
        builder = self.builder
        place = builder.add(_long(row), builder.select(self.down, _long(_HALF), _long(0)))
        below = builder.icmp_signed(">=", place, _long(SIDE))
        within = builder.select(below, builder.sub(place, _long(SIDE)), place)
        offset = builder.mul(builder.add(builder.mul(within, self.channels), channel), _long(SIDE))
        left, right = (builder.select(below, self.parents[k + 2], self.parents[k]) for k in (0, 1))
        return builder.gep(left, [offset]), builder.gep(right, [offset])

    def each(self, emit: Callable[[Any, bool], None]) -> None:
        """Emit a loop over channels, for windows that begin in the middle of the left block and for others."""

        def loop_over(right: bool) -> None:
            with cgutils.for_range(self.builder, self.channels) as loop:
                emit(loop.index, right)

        if_else(self.builder, self.right, loop_over)


def _make_loop(emit: Callable[[_Blocks, Any, bool], None]) -> Any:
    """Make an intrinsic over the channels of a block; emit(blocks, channel, right) is the code of one.

    Its arguments: `coarse`, float32, has the parents at four `offsets`; the window begins in the middle of the upper
    ones if `down`, of the left ones if `right`. `fine`, float32, has the block from element `origin` on, `masks`,
    float32, the weights of its rows from element `mask_start` on; strides count elements.
    """

    @intrinsic
    def loop(  # type: ignore[no-untyped-def]
        typing_context, coarse, offsets, down, right, fine, origin, row_stride, channel_stride, channels, masks,
        mask_start, mask_stride,
    ):  # fmt: skip
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            blocks = _Blocks(context, builder, signature.args, arguments)
            blocks.each(partial(emit, blocks))
            return context.get_dummy_value()

        flag, long = types.boolean, types.int64
        return types.void(coarse, offsets, flag, flag, fine, long, long, long, long, masks, long, long), generate

    return loop


def _make_add(even: tuple[float, ...], odd: tuple[float, ...]) -> Any:
    """Make fine[row, c, :] += mask[row, :] * spline[row, c, :]."""
    neighbors = [k for k in range(4) if even[k] or odd[k]]

    def widen(builder: Any, window: Any) -> Any:
        total = None
        for k in neighbors:
            spread = shuffle(builder, window, UNDEFINED, [j // 2 + k for j in range(SIDE)])
            weights = _alternating(even[k], odd[k])
            total = builder.fmul(weights, spread) if total is None else apply(builder, "fma", weights, spread, total)
        return total

    def emit(blocks: _Blocks, channel: Any, right: bool) -> None:
        builder, rows = blocks.builder, []
        for n in range(_HALF + neighbors[-1]):
            places = blocks.window_row(channel, n)
            window = load(builder, places[0])
            if right:
                window = shuffle(builder, window, load(builder, places[1]), _MIDDLE)
            rows.append(widen(builder, window))
        for row in range(SIDE):
            total = None
            for k in neighbors:
                total = _multiply_add(builder, (even, odd)[row % 2][k], rows[row // 2 + k], total)
            place, mask = blocks.fine_row(channel, row), blocks.mask(row)
            store(builder, apply(builder, "fma", total, mask, load(builder, place)), place)

    return _make_loop(emit)


def _make_gather(even: tuple[float, ...], odd: tuple[float, ...]) -> Any:
    """Make the transpose of `_make_add`: the gradient of mask * spline is added to the coarser grid."""
    neighbors = [k for k in range(4) if even[k] or odd[k]]

    def narrow(builder: Any, row: Any) -> Any:
        # value 2 i + j of the finer grid goes to place i + k; places out of range read zeros
        total = None
        for k in neighbors:
            for j, weight in enumerate((even[k], odd[k])):
                places = [2 * (n - k) + j if 0 <= n - k < _HALF else SIDE for n in range(SIDE)]
                if weight:
                    total = _multiply_add(builder, weight, shuffle(builder, row, constant(0.0), places), total)
        return total

    def emit(blocks: _Blocks, channel: Any, right: bool) -> None:
        builder = blocks.builder
        rows: list[Any] = [None] * _WINDOW
        for row in range(SIDE):
            value = builder.fmul(load(builder, blocks.fine_row(channel, row)), blocks.mask(row))
            for k in neighbors:
                rows[row // 2 + k] = _multiply_add(builder, (even, odd)[row % 2][k], value, rows[row // 2 + k])
        for n, row in enumerate(rows[: _HALF + neighbors[-1]]):
            total, zero = narrow(builder, row), constant(0.0)
            parts = [total]
            if right:
                parts = [shuffle(builder, a, b, _MIDDLE) for a, b in ((zero, total), (total, zero))]
            for part, place in zip(parts, blocks.window_row(channel, n), strict=False):
                store(builder, builder.fadd(load(builder, place), part), place)

    return _make_loop(emit)


add_refined = _make_add(_REFINE_EVEN, _REFINE_ODD)
gather_refined = _make_gather(_REFINE_EVEN, _REFINE_ODD)
add_sampled = _make_add(_SAMPLE_EVEN, _SAMPLE_ODD)
gather_sampled = _make_gather(_SAMPLE_EVEN, _SAMPLE_ODD)
