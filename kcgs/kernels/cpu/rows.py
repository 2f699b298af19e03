"""Vector code over the rows of pixels that a Gaussian touches: it adds the Gaussian, or gathers its gradients.

`add_rows` and `gather_rows` visit the rows of a tile or block; `add_sheared` and `gather_sheared` those of a narrow
Gaussian, across tiles. Their arguments in common:

- pixels, origin: float32 array, and the element at the first row, channel and column;
- row_stride, channel_stride, channels: elements from a row, and from a channel of it, to the next, and their number;
- first, last: rows to visit, last + 1;
- coefficients or shape: float64, see ellipse.enter_tile and `_ShearedRows`;
- colors, color_start: float32 array, and the Gaussian's first element;
- least_exponent: of 2, below which a weight is zero;
- masks, mask_start: float32 array of membership, and the tile's first element, below 0 if there is none;
- sums, geometry: float32 array of SIDE elements for each term, and whether to sum moments of z, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .channels import Channels, Sums
from .simd import FLOAT, LONG, SIDE, ZERO, apply, broadcast, constant, exp2, if_else, load, pointer, ramp


class _TileGaussian:
    """A Gaussian in a tile: its whitened coordinates, and its weight along a row."""

    def __init__(self, builder: Any, coefficients: Any, least_exponent: Any) -> None:
        self.builder = builder
        k = [builder.fptrunc(builder.load(builder.gep(coefficients, [ir.Constant(LONG, i)])), FLOAT) for i in range(5)]
        column = ramp()
        first = apply(builder, "fma", broadcast(builder, k[1]), column, broadcast(builder, k[0]))
        self.first = first
        self.negative = builder.fneg(builder.fmul(first, first))
        self.base = apply(builder, "fma", broadcast(builder, k[3]), column, broadcast(builder, k[2]))
        self.slope = broadcast(builder, k[4])
        self.least_exponent = least_exponent

    def weight(self, row: Any, mask: Any) -> tuple[Any, Any]:
        """Return z2 and the weight; `row` counts from the middle of the tile, `mask` is a pointer or None."""
        builder = self.builder
        second = apply(builder, "fma", self.slope, broadcast(builder, row), self.base)
        weight = _weigh(builder, second, self.negative, self.least_exponent)
        if mask is not None:
            weight = builder.fmul(weight, load(builder, mask))
        return second, weight


def _weigh(builder: Any, second: Any, negative: Any, least_exponent: Any) -> Any:
    """Return 2 ** (negative - second ** 2), 0 where the exponent is below the least."""
    exponent = apply(builder, "fma", builder.fneg(second), second, negative)
    return builder.select(builder.fcmp_ordered(">=", exponent, least_exponent), exp2(builder, exponent), constant(0.0))


class _Rows:
    """The arguments that all loops over rows share, as LLVM values."""

    def __init__(self, context: Any, builder: Any, argument_types: Any, arguments: Any) -> None:
        self.builder = builder
        self.row_stride, self.channel_stride, self.channels = arguments[2:5]
        self.first, self.last = arguments[5:7]
        self.pixels = pointer(context, builder, argument_types[0], arguments[0], arguments[1])
        self.shape = pointer(context, builder, argument_types[7], arguments[7], ZERO)
        self.colors = pointer(context, builder, argument_types[8], arguments[8], arguments[9])
        self.least_exponent = broadcast(builder, arguments[10])
        self.is_rgb = builder.icmp_signed("==", self.channels, ir.Constant(LONG, 3))

    def per_channel(self, is_rgb: bool) -> Channels:
        """Return what emits the code for every channel."""
        return Channels(self.builder, self.colors, self.channels, self.channel_stride, is_rgb)

    @contextmanager
    def each_index(self) -> Iterator[Any]:
        """Emit a loop over the indices of the rows."""
        with cgutils.for_range_slice(self.builder, self.first, self.last, ir.Constant(LONG, 1)) as (row, _):
            yield row


class _TileRows(_Rows):
    """Rows of a tile, with a mask or without."""

    def __init__(self, context: Any, builder: Any, argument_types: Any, arguments: Any) -> None:
        super().__init__(context, builder, argument_types, arguments)
        self.masks = pointer(context, builder, argument_types[11], arguments[11], arguments[12])
        self.is_masked = builder.icmp_signed(">=", arguments[12], ZERO)
        self.gaussian = _TileGaussian(builder, self.shape, self.least_exponent)

    def specialize(self, emit_rgb: Callable[[], None], emit_general: Callable[[], None]) -> None:
        """Emit the code for three channels without a mask, and that for all else."""
        is_special = self.builder.and_(self.is_rgb, self.builder.not_(self.is_masked))
        if_else(self.builder, is_special, lambda special: emit_rgb() if special else emit_general())

    @contextmanager
    def each_row(self, masked: bool) -> Iterator[tuple[Any, Any, Any]]:
        """Emit a loop over the rows; yield z2, weight, and pointer to the pixels."""
        builder = self.builder
        with self.each_index() as row:
            mask = builder.gep(self.masks, [builder.mul(row, ir.Constant(LONG, SIDE))]) if masked else None
            middle = builder.fadd(builder.sitofp(row, FLOAT), ir.Constant(FLOAT, -(SIDE - 1) / 2))
            second, weight = self.gaussian.weight(middle, mask)
            yield second, weight, builder.gep(self.pixels, [builder.mul(row, self.row_stride)])


# types of origin, strides of rows and channels, channels, first and last row
_ROW_TYPES = (types.int64,) * 6


@intrinsic
def add_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, origin, row_stride, channel_stride, channels, first, last, coefficients, colors,
    color_start, least_exponent, masks, mask_start,
):  # fmt: skip
    """pixels[row, c, :] += weight[row, :] * colors[c] for rows first ... last - 1; mask_start < 0: no mask."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _TileRows(context, builder, signature.args, arguments)

        def emit(masked: bool, is_rgb: bool = False) -> None:
            channel_code = rows.per_channel(is_rgb)
            with rows.each_row(masked) as (_, weight, pixels):
                channel_code.add(weight, pixels)

        rows.specialize(lambda: emit(False, True), lambda: if_else(builder, rows.is_masked, emit))
        return context.get_dummy_value()

    return types.void(
        pixels, *_ROW_TYPES, coefficients, colors, types.int64, types.float32, masks, types.int64
    ), generate


@intrinsic
def gather_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, origin, row_stride, channel_stride, channels, first, last, coefficients, colors,
    color_start, least_exponent, masks, mask_start, sums, geometry,
):  # fmt: skip
    """Add to sums[k, column] over rows: w g_c for every channel c, then, with v = w sum_c g_c colors_c and where
    `geometry`, v z1, v z2, v z1 z1, v z1 z2, v z2 z2."""  # noqa: D205, D209

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _TileRows(context, builder, signature.args, arguments)
        sums_pointer = pointer(context, builder, signature.args[13], arguments[13], ZERO)

        def emit(masked: bool, geometry: bool, is_rgb: bool = False) -> None:
            channel_code = rows.per_channel(is_rgb)
            sums = Sums(channel_code, sums_pointer, 3 if geometry else 0)
            with rows.each_row(masked) as (second, weight, pixels):
                value = sums.gather(weight, pixels)
                if geometry:
                    along = builder.fmul(value, second)
                    sums.add(0, value)
                    sums.add(1, along)
                    sums.add(2, along, second)
            # z1 is the same in every row of the tile: it multiplies the sums, not the terms
            first = rows.gaussian.first
            totals = [builder.load(total) for total in sums.moments]
            if geometry:
                z1 = builder.fmul(totals[0], first)
                totals = [z1, totals[1], builder.fmul(z1, first), builder.fmul(totals[1], first), totals[2]]
            sums.finish(totals)

        def emit_general() -> None:
            if_else(builder, arguments[14], lambda g: if_else(builder, rows.is_masked, lambda masked: emit(masked, g)))

        def emit_rgb() -> None:
            if_else(builder, arguments[14], lambda geometry: emit(False, geometry, True))

        rows.specialize(emit_rgb, emit_general)
        return context.get_dummy_value()

    long, single = types.int64, types.float32
    return types.void(
        pixels, *_ROW_TYPES, coefficients, colors, long, single, masks, long, sums, types.boolean
    ), generate


class _ShearedRows(_Rows):
    """Rows of a narrow Gaussian, each with vectors of its own around its middle there, where no mask is needed.

    `shape` holds nine float64: x of the first pixel of the vectors of row 0, before it is rounded; how much it grows
    from row to row; the mean's x; y of row 0 minus the mean's; the slopes of z1 along x, of z2 along x and along y; the
    least and the largest x at which vectors may begin.
    """

    def __init__(self, context: Any, builder: Any, argument_types: Any, arguments: Any) -> None:
        super().__init__(context, builder, argument_types, arguments)
        self.numbers = [builder.load(builder.gep(self.shape, [ir.Constant(LONG, k)])) for k in range(9)]
        self.vectors = arguments[11]

    @contextmanager
    def each_vector(self) -> Iterator[tuple[Any, Any, Any, Any]]:
        """Emit loops over rows and vectors; yield z1, z2, weight, and pointer to the pixels."""
        builder = self.builder
        start, shear, mean, down, slope1_x, slope2_x, slope2_y, low, high = self.numbers
        slopes = [broadcast(builder, builder.fptrunc(slope, FLOAT)) for slope in (slope1_x, slope2_x)]
        columns, double = ramp(), ir.DoubleType()
        with self.each_index() as row:
            index = builder.sitofp(row, double)
            left = _scalar(builder, "fma", shear, index, start)
            left = _scalar(builder, "floor", _scalar(builder, "minnum", _scalar(builder, "maxnum", left, low), high))
            dy = builder.fadd(index, down)
            # of the middle of the first vector
            dx = builder.fadd(builder.fsub(left, mean), ir.Constant(double, SIDE / 2))
            begin = builder.add(builder.fptosi(left, LONG), builder.mul(row, self.row_stride))
            with cgutils.for_range(builder, self.vectors) as loop:
                along = builder.fadd(dx, builder.sitofp(builder.mul(loop.index, ir.Constant(LONG, SIDE)), double))
                z2 = _scalar(builder, "fma", slope2_x, along, builder.fmul(slope2_y, dy))
                middle = builder.fmul(slope1_x, along), z2
                z1, z2 = (
                    apply(builder, "fma", slope, columns, broadcast(builder, builder.fptrunc(value, FLOAT)))
                    for slope, value in zip(slopes, middle, strict=True)
                )
                weight = _weigh(builder, z2, builder.fneg(builder.fmul(z1, z1)), self.least_exponent)
                place = builder.add(begin, builder.mul(loop.index, ir.Constant(LONG, SIDE)))
                yield z1, z2, weight, builder.gep(self.pixels, [place])


def _scalar(builder: Any, name: str, *arguments: Any) -> Any:
    double = ir.DoubleType()
    kind = ir.FunctionType(double, [double] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.f64"), arguments)


@intrinsic
def add_sheared(  # type: ignore[no-untyped-def]
    typing_context, pixels, origin, row_stride, channel_stride, channels, first, last, shape, colors, color_start,
    least_exponent, vectors,
):  # fmt: skip
    """pixels[row, c, :] += weight[row, :] * colors[c] around the middle of each row; see `_ShearedRows`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _ShearedRows(context, builder, signature.args, arguments)

        def emit(is_rgb: bool) -> None:
            channel_code = rows.per_channel(is_rgb)
            with rows.each_vector() as (_, _, weight, pixels):
                channel_code.add(weight, pixels)

        if_else(builder, rows.is_rgb, emit)
        return context.get_dummy_value()

    return types.void(pixels, *_ROW_TYPES, shape, colors, types.int64, types.float32, types.int64), generate


@intrinsic
def gather_sheared(  # type: ignore[no-untyped-def]
    typing_context, pixels, origin, row_stride, channel_stride, channels, first, last, shape, colors, color_start,
    least_exponent, vectors, sums, geometry,
):  # fmt: skip
    """Add to sums[k, column] what `gather_rows` does, around the middle of each row."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _ShearedRows(context, builder, signature.args, arguments)
        sums_pointer = pointer(context, builder, signature.args[12], arguments[12], ZERO)

        def emit(geometry: bool, is_rgb: bool) -> None:
            channel_code = rows.per_channel(is_rgb)
            sums = Sums(channel_code, sums_pointer, 5 if geometry else 0)
            with rows.each_vector() as (z1, z2, weight, pixels):
                value = sums.gather(weight, pixels)
                if geometry:
                    first, second = builder.fmul(value, z1), builder.fmul(value, z2)
                    sums.add(0, first)
                    sums.add(1, second)
                    sums.add(2, first, z1)
                    sums.add(3, first, z2)
                    sums.add(4, second, z2)
            sums.finish([builder.load(total) for total in sums.moments])

        if_else(builder, rows.is_rgb, lambda is_rgb: if_else(builder, arguments[13], lambda g: emit(g, is_rgb)))
        return context.get_dummy_value()

    return types.void(
        pixels, *_ROW_TYPES, shape, colors, types.int64, types.float32, types.int64, sums, types.boolean
    ), generate
