"""From a grid to one of half its spacing, and back: blocks of 16 x 16 as vector code.

Along an axis, values 2 i and 2 i + 1 of the finer grid are each a sum of four neighbours, i ... i + 3, of a window of
the coarser one, which begins at a block's first node or in its middle. Blocks lie in memory as [row][channel][column].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .simd import _FLOAT, _INT, _LONG, _START, _VECTOR, SIDE, _call, _constant, _load, _pointer, _store

# weights of the four neighbours: refinement of cubic B-splines, exact; and the spline at pixel centres, a quarter and
# three quarters of the way from one node to the next
REFINE = ((0.5, 0.5, 0.0, 0.0), (0.125, 0.75, 0.125, 0.0))
SAMPLE = (
    (27 / 384, 235 / 384, 121 / 384, 1 / 384),
    (1 / 384, 121 / 384, 235 / 384, 27 / 384),
)

_HALF = SIDE // 2
_WINDOW = _HALF + 3
_NOTHING = ir.Constant(_VECTOR, ir.Undefined)


def _long(value: int) -> ir.Constant:
    return ir.Constant(_LONG, value)


def _shuffle(builder: Any, first: Any, second: Any, places: Any) -> Any:
    kind = ir.VectorType(_INT, SIDE)
    return builder.shuffle_vector(first, second, ir.Constant(kind, [ir.Constant(_INT, p) for p in places]))


def _multiply_add(builder: Any, factor: float, value: Any, total: Any) -> Any:
    if factor == 0.0:
        return total
    return (
        builder.fmul(_constant(factor), value)
        if total is None
        else _call(builder, "fma", _constant(factor), value, total)
    )


def _alternating(even: float, odd: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, float(v)) for _ in range(_HALF) for v in (even, odd)])


class _Blocks:
    """A block of the finer grid and the four of the coarser one that it reads, as LLVM values."""

    def __init__(self, context: Any, builder: Any, types_of: Any, arguments: Any) -> None:
        self.builder = builder
        self.coarse, self.offsets, self.down, self.right = arguments[:4]
        at = _pointer(context, builder, types_of[1], arguments[1], _START)
        offsets = [builder.load(builder.gep(at, [_long(k)])) for k in range(4)]
        self.parents = [_pointer(context, builder, types_of[0], arguments[0], offset) for offset in offsets]
        self.fine = _pointer(context, builder, types_of[4], arguments[4], arguments[5])
        self.row_stride, self.channel_stride, self.channels = arguments[6:9]
        self.masks = _pointer(context, builder, types_of[9], arguments[9], arguments[10])
        self.mask_stride = arguments[11]

    def fine_row(self, channel: Any, row: int) -> Any:
        """Return the pointer to a row of the finer block."""
        builder = self.builder
        place = builder.mul(channel, self.channel_stride)
        return builder.gep(self.fine, [builder.add(place, builder.mul(self.row_stride, _long(row)))])

    def mask(self, row: int) -> Any:
        """Weights of a row."""
        return _load(self.builder, self.builder.gep(self.masks, [self.builder.mul(self.mask_stride, _long(row))]))

    def window_row(self, channel: Any, row: int) -> tuple[Any, Any]:
        """Return the pointers to a row of the window, in the left block and in the right one."""
        builder = self.builder
        place = builder.add(_long(row), builder.select(self.down, _long(_HALF), _long(0)))
        below = builder.icmp_signed(">=", place, _long(SIDE))
        within = builder.select(below, builder.sub(place, _long(SIDE)), place)
        at = builder.mul(builder.add(builder.mul(within, self.channels), channel), _long(SIDE))
        left, right = (builder.select(below, self.parents[k + 2], self.parents[k]) for k in (0, 1))
        return builder.gep(left, [at]), builder.gep(right, [at])

    def each(self, emit: Callable[[Any, bool], None]) -> None:
        """Emit a loop over channels, for windows that begin in the middle of the left block and for others."""
        builder = self.builder
        with builder.if_else(self.right) as (then, otherwise):
            for branch, right in ((then, True), (otherwise, False)):
                with branch, cgutils.for_range(builder, self.channels) as loop:
                    emit(loop.index, right)


def _signature(coarse: Any, offsets: Any, fine: Any, masks: Any) -> Any:
    long = types.int64
    return types.void(coarse, offsets, types.boolean, types.boolean, fine, long, long, long, long, masks, long, long)


def _make_add(even: tuple[float, ...], odd: tuple[float, ...], replaces: bool = False) -> Any:
    used = [k for k in range(4) if even[k] or odd[k]]

    def widen(builder: Any, window: Any) -> Any:
        total = None
        for k in used:
            spread = _shuffle(builder, window, _NOTHING, [j // 2 + k for j in range(SIDE)])
            weights = _alternating(even[k], odd[k])
            total = builder.fmul(weights, spread) if total is None else _call(builder, "fma", weights, spread, total)
        return total

    @intrinsic
    def add(  # type: ignore[no-untyped-def]
        typing_context, coarse, offsets, down, right, fine, at, row_stride, channel_stride, channels, masks, mask_at,
        mask_stride,
    ):  # fmt: skip
        """fine[row, c, :] += mask[row, :] * what the coarser grid says there; or = in place of +=."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            blocks = _Blocks(context, builder, signature.args, arguments)

            def emit(channel: Any, right: bool) -> None:
                rows = []
                for n in range(_HALF + used[-1]):
                    places = blocks.window_row(channel, n)
                    window = _load(builder, places[0])
                    if right:
                        window = _shuffle(builder, window, _load(builder, places[1]), range(_HALF, _HALF + SIDE))
                    rows.append(widen(builder, window))
                for row in range(SIDE):
                    total = None
                    for k, weight in enumerate((even, odd)[row % 2]):
                        if weight:
                            total = _multiply_add(builder, weight, rows[row // 2 + k], total)
                    place, mask = blocks.fine_row(channel, row), blocks.mask(row)
                    if replaces:
                        value = builder.fmul(total, mask)
                    else:
                        value = _call(builder, "fma", total, mask, _load(builder, place))
                    _store(builder, value, place)

            blocks.each(emit)
            return context.get_dummy_value()

        return _signature(coarse, offsets, fine, masks), generate

    return add


def _make_gather(even: tuple[float, ...], odd: tuple[float, ...]) -> Any:
    used = [k for k in range(4) if even[k] or odd[k]]

    def narrow(builder: Any, given: Any) -> Any:
        # value 2 i + j of the finer grid goes to place i + k; what is out of range is read from the zeros
        total = None
        for k in used:
            for j, weight in enumerate((even[k], odd[k])):
                places = [2 * (n - k) + j if 0 <= n - k < _HALF else SIDE for n in range(SIDE)]
                if weight:
                    total = _multiply_add(builder, weight, _shuffle(builder, given, _constant(0.0), places), total)
        return total

    @intrinsic
    def gather(  # type: ignore[no-untyped-def]
        typing_context, coarse, offsets, down, right, fine, at, row_stride, channel_stride, channels, masks, mask_at,
        mask_stride,
    ):  # fmt: skip
        """Add to the coarser grid what mask * fine has for it: the transpose of `add`."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            blocks = _Blocks(context, builder, signature.args, arguments)

            def emit(channel: Any, right: bool) -> None:
                rows: list[Any] = [None] * _WINDOW
                for row in range(SIDE):
                    value = builder.fmul(_load(builder, blocks.fine_row(channel, row)), blocks.mask(row))
                    for k, weight in enumerate((even, odd)[row % 2]):
                        rows[row // 2 + k] = _multiply_add(builder, weight, value, rows[row // 2 + k])
                for n, row in enumerate(rows[: _HALF + used[-1]]):
                    total, zero = narrow(builder, row), _constant(0.0)
                    low, high = (range(_HALF, _HALF + SIDE) for _ in range(2))
                    parts = [total]
                    if right:
                        parts = [_shuffle(builder, zero, total, low), _shuffle(builder, total, zero, high)]
                    for part, place in zip(parts, blocks.window_row(channel, n), strict=False):
                        _store(builder, builder.fadd(_load(builder, place), part), place)

            blocks.each(emit)
            return context.get_dummy_value()

        return _signature(coarse, offsets, fine, masks), generate

    return gather


add_refined, gather_refined = _make_add(*REFINE), _make_gather(*REFINE)
add_sampled, gather_sampled = _make_add(*SAMPLE), _make_gather(*SAMPLE)
set_sampled = _make_add(*SAMPLE, replaces=True)
