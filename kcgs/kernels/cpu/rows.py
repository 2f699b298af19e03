"""The loops over the rows of pixels that a Gaussian touches, as vector code: evaluate it there, or gather gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .simd import FLOAT, LONG, SIDE, START, apply, both, broadcast, constant, exp2, load, pointer, ramp, store


class _Columns:
    """A Gaussian over the columns of a tile: its whitened coordinates, and its weight along a row."""

    def __init__(self, builder: Any, coefficients: Any, lowest: Any) -> None:
        self.builder = builder
        k = [builder.fptrunc(builder.load(builder.gep(coefficients, [ir.Constant(LONG, i)])), FLOAT) for i in range(5)]
        column = ramp()
        first = apply(builder, "fma", broadcast(builder, k[1]), column, broadcast(builder, k[0]))
        self.first = first
        self.negative = builder.fneg(builder.fmul(first, first))
        self.base = apply(builder, "fma", broadcast(builder, k[3]), column, broadcast(builder, k[2]))
        self.slope = broadcast(builder, k[4])
        self.lowest = lowest

    def weight(self, row: Any, mask: Any) -> tuple[Any, Any]:
        """Second coordinate and weight; `row` counts from the middle of the tile, `mask` is a pointer or None."""
        builder = self.builder
        second = apply(builder, "fma", self.slope, broadcast(builder, row), self.base)
        weight = _weigh(builder, second, self.negative, self.lowest)
        if mask is not None:
            weight = builder.fmul(weight, load(builder, mask))
        return second, weight


def _weigh(builder: Any, second: Any, negative: Any, lowest: Any) -> Any:
    """Return 2 ** (negative - second ** 2), 0 where the exponent is below the lowest."""
    exponent = apply(builder, "fma", builder.fneg(second), second, negative)
    return builder.select(builder.fcmp_ordered(">=", exponent, lowest), exp2(builder, exponent), constant(0.0))


class _Rows:
    """The arguments that all loops over rows share, as LLVM values."""

    def __init__(self, context: Any, builder: Any, types_of: Any, arguments: Any) -> None:
        self.builder = builder
        self.row_stride, self.channel_stride, self.channels = arguments[2:5]
        self.first, self.last = arguments[5:7]
        self.pixels = pointer(context, builder, types_of[0], arguments[0], arguments[1])
        self.shape = pointer(context, builder, types_of[7], arguments[7], START)
        self.colors = pointer(context, builder, types_of[8], arguments[8], arguments[9])
        self.lowest = broadcast(builder, arguments[10])
        self.are_three = builder.icmp_signed("==", self.channels, ir.Constant(LONG, 3))

    @contextmanager
    def each_number(self) -> Iterator[Any]:
        """Emit a loop over the numbers of the rows."""
        with cgutils.for_range_slice(self.builder, self.first, self.last, ir.Constant(LONG, 1)) as (row, _):
            yield row


class _Aligned(_Rows):
    """Rows of a tile, with a mask or without."""

    def __init__(self, context: Any, builder: Any, types_of: Any, arguments: Any) -> None:
        super().__init__(context, builder, types_of, arguments)
        self.masks = pointer(context, builder, types_of[11], arguments[11], arguments[12])
        self.masked = builder.icmp_signed(">=", arguments[12], START)
        self.geometry = _Columns(builder, self.shape, self.lowest)

    @contextmanager
    def each_row(self, masked: bool) -> Iterator[tuple[Any, Any, Any]]:
        """Emit a loop over the rows; yield second coordinate, weight, and pointer to the pixels."""
        builder = self.builder
        with self.each_number() as row:
            mask = builder.gep(self.masks, [builder.mul(row, ir.Constant(LONG, SIDE))]) if masked else None
            middle = builder.fadd(builder.sitofp(row, FLOAT), ir.Constant(FLOAT, -(SIDE - 1) / 2))
            second, weight = self.geometry.weight(middle, mask)
            yield second, weight, builder.gep(self.pixels, [builder.mul(row, self.row_stride)])


_LONGS = types.int64
_ROWS = (_LONGS,) * 6  # offset, strides of rows and channels, channels, first and last row


class _Colors:
    """What is done for every channel: three of them without a loop, and what is summed stays in registers."""

    def __init__(self, rows: _Rows, three: bool) -> None:
        self.builder, self.colors, self.channels = rows.builder, rows.colors, rows.channels
        self.stride, self.three = rows.channel_stride, three

    def each(self, work: Callable[[Any, Any], None], pixels: Any) -> None:
        """Emit work(channel, pointer to its pixels)."""

        def visit(channel: Any) -> None:
            work(channel, self.builder.gep(pixels, [self.builder.mul(channel, self.stride)]))

        if self.three:
            for c in range(3):
                visit(ir.Constant(LONG, c))
        else:
            with cgutils.for_range(self.builder, self.channels) as loop:
                visit(loop.index)

    def color(self, channel: Any) -> Any:
        """Return a color in all elements of a vector."""
        return broadcast(self.builder, self.builder.load(self.builder.gep(self.colors, [channel])))

    def add(self, weight: Any, pixels: Any) -> None:
        """Emit pixels[c] += weight * colors[c]."""

        def work(channel: Any, place: Any) -> None:
            value = apply(self.builder, "fma", weight, self.color(channel), load(self.builder, place))
            store(self.builder, value, place)

        self.each(work, pixels)


class _Sums:
    """Sums over rows of 16: w g_c of each channel, then the moments of v = w sum_c g_c colors_c."""

    def __init__(self, builder: Any, colors: _Colors, sums: Any, moments: int) -> None:
        self.builder, self.colors, self.at = builder, colors, sums
        zero = constant(0.0)
        self.totals = [cgutils.alloca_once_value(builder, zero) for _ in range(3 if colors.three else 0)]
        # variables, which LLVM keeps in registers
        self.moments = [cgutils.alloca_once_value(builder, zero) for _ in range(moments)]

    def gather(self, weight: Any, pixels: Any) -> Any:
        """Add w g_c; return w sum_c g_c colors_c."""
        builder = self.builder
        # -0.0 added changes nothing, not even the sign of a zero
        value = cgutils.alloca_once_value(builder, constant(-0.0))

        def work(channel: Any, place: Any) -> None:
            grad = load(builder, place)
            if self.totals:
                total = self.totals[channel.constant]
                builder.store(apply(builder, "fma", weight, grad, builder.load(total)), total)
            else:
                store(
                    builder,
                    apply(builder, "fma", weight, grad, load(builder, self.at, channel)),
                    self.at,
                    channel,
                )
            if self.moments:
                builder.store(apply(builder, "fma", grad, self.colors.color(channel), builder.load(value)), value)

        self.colors.each(work, pixels)
        return builder.fmul(builder.load(value), weight)

    def add(self, k: int, first: Any, second: Any = None) -> None:
        """Add a term, or the product of two, to a moment."""
        builder, total = self.builder, self.moments[k]
        if second is None:
            builder.store(builder.fadd(builder.load(total), first), total)
        else:
            builder.store(apply(builder, "fma", first, second, builder.load(total)), total)

    def finish(self, moments: list[Any]) -> None:
        """Add what is in registers to the sums in memory."""
        builder = self.builder
        terms = [(ir.Constant(LONG, c), builder.load(total)) for c, total in enumerate(self.totals)]
        for k, moment in enumerate(moments):
            terms.append((builder.add(self.colors.channels, ir.Constant(LONG, k)), moment))
        for at, term in terms:
            store(builder, builder.fadd(load(builder, self.at, at), term), self.at, at)


def _special_or(builder: Any, condition: Any, special: Callable[[], None], general: Callable[[], None]) -> None:
    both(builder, condition, lambda is_special: special() if is_special else general())


@intrinsic
def add_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, at, row_stride, channel_stride, channels, first, last, coefficients, colors, color_at,
    lowest, masks, mask_at,
):  # fmt: skip
    """pixels[row, c, :] += weight[row, :] * colors[c] for rows first ... last - 1; mask_at < 0: no mask."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Aligned(context, builder, signature.args, arguments)

        def emit(masked: bool, three: bool = False) -> None:
            colors = _Colors(call, three)
            with call.each_row(masked) as (_, weight, pixels):
                colors.add(weight, pixels)

        special = builder.and_(call.are_three, builder.not_(call.masked))
        _special_or(builder, special, lambda: emit(False, True), lambda: both(builder, call.masked, emit))
        return context.get_dummy_value()

    return types.void(pixels, *_ROWS, coefficients, colors, _LONGS, types.float32, masks, _LONGS), generate


@intrinsic
def gather_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, at, row_stride, channel_stride, channels, first, last, coefficients, colors, color_at,
    lowest, masks, mask_at, sums, moments,
):  # fmt: skip
    """Add to sums[k, column] over rows: w g_c for every channel c, then, with v = w sum_c g_c colors_c and where
    `moments` is true, v z1, v z2, v z1 z1, v z1 z2, v z2 z2."""  # noqa: D205, D209

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Aligned(context, builder, signature.args, arguments)
        sums_at = pointer(context, builder, signature.args[13], arguments[13], START)

        def emit(masked: bool, moments: bool, three: bool = False) -> None:
            colors = _Colors(call, three)
            sums = _Sums(builder, colors, sums_at, 3 if moments else 0)
            with call.each_row(masked) as (second, weight, pixels):
                value = sums.gather(weight, pixels)
                if moments:
                    along = builder.fmul(value, second)
                    sums.add(0, value)
                    sums.add(1, along)
                    sums.add(2, along, second)
            # z1 is the same in every row of the tile: it multiplies the sums, not the terms
            first = call.geometry.first
            totals = [builder.load(total) for total in sums.moments]
            if moments:
                once = builder.fmul(totals[0], first)
                totals = [once, totals[1], builder.fmul(once, first), builder.fmul(totals[1], first), totals[2]]
            sums.finish(totals)

        special = builder.and_(call.are_three, builder.not_(call.masked))

        def general() -> None:
            both(builder, arguments[14], lambda moments: both(builder, call.masked, lambda m: emit(m, moments)))

        def of_three() -> None:
            both(builder, arguments[14], lambda moments: emit(False, moments, True))

        _special_or(builder, special, of_three, general)
        return context.get_dummy_value()

    return types.void(
        pixels, *_ROWS, coefficients, colors, _LONGS, types.float32, masks, _LONGS, sums, types.boolean
    ), generate


class _Sheared(_Rows):
    """Rows of a narrow Gaussian, each with vectors of its own around its middle there, where no mask is needed.

    `shape` holds nine float64. The first two are x of the first pixel of the vectors of row 0, before it is rounded,
    and how much it grows from row to row. Then come the mean's x, the distance of row 0 from the mean's y, the three
    slopes of z, and the least and largest x at which vectors may begin.
    """

    def __init__(self, context: Any, builder: Any, types_of: Any, arguments: Any) -> None:
        super().__init__(context, builder, types_of, arguments)
        self.numbers = [builder.load(builder.gep(self.shape, [ir.Constant(LONG, k)])) for k in range(9)]
        self.vectors = arguments[11]

    @contextmanager
    def each_vector(self) -> Iterator[tuple[Any, Any, Any, Any]]:
        """Emit loops over rows and vectors; yield z1, z2, weight, and pointer to the pixels."""
        builder = self.builder
        start, shift, mean, down, rise1, rise2, rise3, low, high = self.numbers
        slopes = [broadcast(builder, builder.fptrunc(rise, FLOAT)) for rise in (rise1, rise2)]
        columns, double = ramp(), ir.DoubleType()
        with self.each_number() as row:
            number = builder.sitofp(row, double)
            left = _scalar(builder, "fma", shift, number, start)
            left = _scalar(builder, "floor", _scalar(builder, "minnum", _scalar(builder, "maxnum", left, low), high))
            dy = builder.fadd(number, down)
            # of the middle of the first vector
            dx = builder.fadd(builder.fsub(left, mean), ir.Constant(double, SIDE / 2))
            at = builder.add(builder.fptosi(left, LONG), builder.mul(row, self.row_stride))
            with cgutils.for_range(builder, self.vectors) as loop:
                along = builder.fadd(dx, builder.sitofp(builder.mul(loop.index, ir.Constant(LONG, SIDE)), double))
                middle = [builder.fmul(rise1, along), _scalar(builder, "fma", rise2, along, builder.fmul(rise3, dy))]
                z1, z2 = (
                    apply(builder, "fma", slope, columns, broadcast(builder, builder.fptrunc(value, FLOAT)))
                    for slope, value in zip(slopes, middle, strict=True)
                )
                weight = _weigh(builder, z2, builder.fneg(builder.fmul(z1, z1)), self.lowest)
                place = builder.add(at, builder.mul(loop.index, ir.Constant(LONG, SIDE)))
                yield z1, z2, weight, builder.gep(self.pixels, [place])


def _scalar(builder: Any, name: str, *arguments: Any) -> Any:
    double = ir.DoubleType()
    kind = ir.FunctionType(double, [double] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.f64"), arguments)


@intrinsic
def add_sheared(  # type: ignore[no-untyped-def]
    typing_context, pixels, at, row_stride, channel_stride, channels, first, last, shape, colors, color_at, lowest,
    vectors,
):  # fmt: skip
    """pixels[row, c, :] += weight[row, :] * colors[c] around the middle of each row; see `_Sheared`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Sheared(context, builder, signature.args, arguments)

        def emit(three: bool) -> None:
            colors = _Colors(call, three)
            with call.each_vector() as (_, _, weight, pixels):
                colors.add(weight, pixels)

        both(builder, call.are_three, emit)
        return context.get_dummy_value()

    return types.void(pixels, *_ROWS, shape, colors, _LONGS, types.float32, _LONGS), generate


@intrinsic
def gather_sheared(  # type: ignore[no-untyped-def]
    typing_context, pixels, at, row_stride, channel_stride, channels, first, last, shape, colors, color_at, lowest,
    vectors, sums, moments,
):  # fmt: skip
    """Add to sums[k, column] what `gather_rows` does, around the middle of each row."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Sheared(context, builder, signature.args, arguments)
        sums_at = pointer(context, builder, signature.args[12], arguments[12], START)

        def emit(moments: bool, three: bool = False) -> None:
            colors = _Colors(call, three)
            sums = _Sums(builder, colors, sums_at, 5 if moments else 0)
            with call.each_vector() as (z1, z2, weight, pixels):
                value = sums.gather(weight, pixels)
                if moments:
                    one, two = builder.fmul(value, z1), builder.fmul(value, z2)
                    sums.add(0, one)
                    sums.add(1, two)
                    sums.add(2, one, z1)
                    sums.add(3, one, z2)
                    sums.add(4, two, z2)
            sums.finish([builder.load(total) for total in sums.moments])

        three, moments = call.are_three, arguments[13]
        both(builder, three, lambda t: both(builder, moments, lambda m: emit(m, t)))
        return context.get_dummy_value()

    return types.void(pixels, *_ROWS, shape, colors, _LONGS, types.float32, _LONGS, sums, types.boolean), generate
