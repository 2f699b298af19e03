"""Vector code from a coarse grid to one of half its spacing, and back, in blocks of 16 x 16.

Along an axis, values 2 i and 2 i + 1 of the finer grid are weighted sums of nodes i ... i + 3 of a window of the
coarser grid. A window begins at a block's first node or in its middle. Blocks lie in memory as [row][channel][column].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from kcgs._numba_internals import cgutils

from .simd import (
    FLOAT,
    HALF,
    HALVES,
    SIDE,
    UNDEFINED,
    VECTOR,
    apply,
    constant,
    if_else,
    load,
    long,
    pointer,
    shuffle,
    store,
)

# weights of the four neighbours of values 2 i and 2 i + 1: the exact refinement of cubic B-splines
_REFINE_EVEN = (0.5, 0.5, 0.0, 0.0)
_REFINE_ODD = (0.125, 0.75, 0.125, 0.0)
# cubic B-splines at pixel centres, a quarter and three quarters of the way from one node to the next
_SAMPLE_EVEN = (27 / 384, 235 / 384, 121 / 384, 1 / 384)
_SAMPLE_ODD = (1 / 384, 121 / 384, 235 / 384, 27 / 384)

# nodes of the coarser grid that a block reads, along an axis: the HALF that it covers, and three more
_WINDOW = HALF + 3


def _multiply_add(builder: Any, factors: ir.Constant, value: Any, total: Any) -> Any:
    return builder.fmul(factors, value) if total is None else apply(builder, "fma", factors, value, total)


def _vector(factors: Sequence[float]) -> ir.Constant:
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, float(np.float32(factor))) for factor in factors])


class _Blocks:
    """A block of the finer grid and the four blocks of the coarser grid that it reads, as LLVM values."""

    def __init__(self, context: Any, builder: Any, argument_types: Any, arguments: Any) -> None:
        self.builder = builder
        self.down, self.right = arguments[2:4]
        table = pointer(context, builder, argument_types[1], arguments[1], long(0))
        offsets = [builder.load(builder.gep(table, [long(k)])) for k in range(4)]
        self.parents = [pointer(context, builder, argument_types[0], arguments[0], offset) for offset in offsets]
        self.fine = pointer(context, builder, argument_types[4], arguments[4], arguments[5])
        self.row_stride, self.channel_stride, self.channels = arguments[6:9]
        self.masks = pointer(context, builder, argument_types[9], arguments[9], arguments[10])
        self.mask_stride = arguments[11]

    def fine_row(self, channel: Any, row: int, half: int) -> Any:
        """Return the pointer to half a row of the finer block."""
        builder = self.builder
        place = builder.add(builder.mul(channel, self.channel_stride), long(half * HALF))
        return builder.gep(self.fine, [builder.add(place, builder.mul(self.row_stride, long(row)))])

    def mask(self, row: int, half: int) -> Any:
        """Return the weights of half a row."""
        place = self.builder.mul(self.mask_stride, long(row))
        return load(self.builder, self.builder.gep(self.masks, [self.builder.add(place, long(half * HALF))]))

    def window_row(self, channel: Any, row: int, right: bool) -> Callable[[int], Any]:
        """Return a function that takes a node of a row of the window and returns its pointer."""
        builder = self.builder
        place = builder.add(long(row), builder.select(self.down, long(HALF), long(0)))
        below = builder.icmp_signed(">=", place, long(SIDE))
        within = builder.select(below, builder.sub(place, long(SIDE)), place)
        offset = builder.mul(builder.add(builder.mul(within, self.channels), channel), long(SIDE))
        blocks = [builder.gep(builder.select(below, self.parents[k + 2], self.parents[k]), [offset]) for k in (0, 1)]

        def find_node(node: int) -> Any:
            place = node + (HALF if right else 0)
            return builder.gep(blocks[place // SIDE], [long(place % SIDE)])

        return find_node

    def each(self, emit: Callable[[Any, bool], None]) -> None:
        """Emit two loops over channels: one if the window begins in the middle of the left block, one if not."""

        def loop_over(right: bool) -> None:
            with cgutils.for_range(self.builder, self.channels) as loop:
                emit(loop.index, right)

        if_else(self.builder, self.right, loop_over)


def _make_loop(emit: Callable[[_Blocks, Any, bool], None]) -> Any:
    """Make an intrinsic over the channels of a block; emit(blocks, channel, right) emits the code of one channel.

    Arguments of the intrinsic: `coarse`, float32, has the parents at four `offsets`; the window begins in the middle of
    the upper parents if `down`, of the left parents if `right`. `fine`, float32, has the block from element `origin`
    on; `masks`, float32, has the weights of its rows from element `mask_start` on; strides count elements.
    """

    @intrinsic
    def loop(
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
            spread = shuffle(builder, window, UNDEFINED, [j // 2 + k for j in range(HALF)])
            total = _multiply_add(builder, _vector([even[k], odd[k]] * (HALF // 2)), spread, total)
        return total

    def emit_half(blocks: _Blocks, channel: Any, right: bool, half: int) -> None:
        builder, rows, first = blocks.builder, [], half * HALF // 2
        for n in range(HALF + neighbors[-1]):
            find_node = blocks.window_row(channel, n, right)
            if right and first > 0:  # the window's nodes are in two blocks
                halves = load(builder, find_node(0)), load(builder, find_node(HALF))
                window = shuffle(builder, *halves, range(first, first + HALF))
            else:
                window = load(builder, find_node(first))
            rows.append(widen(builder, window))
        for row in range(SIDE):
            total = None
            for k in neighbors:
                if factor := (even, odd)[row % 2][k]:
                    total = _multiply_add(builder, constant(factor), rows[row // 2 + k], total)
            place, mask = blocks.fine_row(channel, row, half), blocks.mask(row, half)
            store(builder, apply(builder, "fma", total, mask, load(builder, place)), place)

    def emit(blocks: _Blocks, channel: Any, right: bool) -> None:
        for half in range(HALVES):
            emit_half(blocks, channel, right, half)

    return _make_loop(emit)


def _make_gather(even: tuple[float, ...], odd: tuple[float, ...]) -> Any:
    """Make the transpose of `_make_add`: the gradient of mask * spline is added to the coarser grid."""
    neighbors = [k for k in range(4) if even[k] or odd[k]]

    def sum_rows(blocks: _Blocks, channel: Any, half: int) -> list[Any]:
        rows: list[Any] = [None] * _WINDOW
        for row in range(SIDE):
            value = load(blocks.builder, blocks.fine_row(channel, row, half))
            value = blocks.builder.fmul(value, blocks.mask(row, half))
            for k in neighbors:
                if factor := (even, odd)[row % 2][k]:
                    rows[row // 2 + k] = _multiply_add(blocks.builder, constant(factor), value, rows[row // 2 + k])
        return rows[: HALF + neighbors[-1]]

    def narrow(builder: Any, left: Any, right: Any) -> list[Any]:
        # values 2 i and 2 i + 1 of the finer grid go to nodes i + k: the terms of all i, then moved by k
        pair = [shuffle(builder, left, right, range(j, SIDE, 2)) for j in (0, 1)]
        nodes: list[Any] = [None, None]
        for k in neighbors:
            term = None
            for values, factor in zip(pair, (even[k], odd[k]), strict=True):
                if factor:
                    term = _multiply_add(builder, constant(factor), values, term)
            for half, places in enumerate((range(-k, HALF - k), range(HALF - k, SIDE - k))):
                if any(0 <= place < HALF for place in places):
                    moved = shuffle(builder, term, constant(0.0), [p if 0 <= p < HALF else HALF for p in places])
                    nodes[half] = moved if nodes[half] is None else builder.fadd(nodes[half], moved)
        return nodes

    def emit(blocks: _Blocks, channel: Any, right: bool) -> None:
        builder = blocks.builder
        columns = [sum_rows(blocks, channel, half) for half in range(HALVES)]
        for n, halves in enumerate(zip(*columns, strict=True)):
            find_node = blocks.window_row(channel, n, right)
            for half, total in enumerate(narrow(builder, halves[0], halves[1])):
                place = find_node(half * HALF)
                store(builder, builder.fadd(load(builder, place), total), place)

    return _make_loop(emit)


add_refined = _make_add(_REFINE_EVEN, _REFINE_ODD)
gather_refined = _make_gather(_REFINE_EVEN, _REFINE_ODD)
add_sampled = _make_add(_SAMPLE_EVEN, _SAMPLE_ODD)
gather_sampled = _make_gather(_SAMPLE_EVEN, _SAMPLE_ODD)
