"""Vector code over the rows of a block that a Gaussian touches: it adds the Gaussian, or gathers its gradients.

Along a column the weight follows from row to row by two products, w <- w g and g <- g c, since its exponent is a
polynomial of degree two. What is stored is g - 1 and c - 1, which are small where a Gaussian is wide: so errors do not
grow along a run. Exponentials begin a run of rows, which is so short that no weight within the ellipse underflows on
the way; the rows of a thin Gaussian begin a run each.

Arguments in common:

- pixels, origin: float32 array, and the first element of the block, [SIDE rows][channel][SIDE columns];
- channels: their number;
- first, last: rows to visit, last + 1;
- shapes, shape_start: float32 array, and the first element of what ellipse.enter made;
- run: rows from an exponential to the next;
- colors, color_start: float32 array, and the Gaussian's first element;
- cutoff: the least weight; smaller ones are zero;
- masks, mask_start: float32 array of membership, and the block's first element, below 0 if there is none.
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
from .simd import FLOAT, LONG, SIDE, VECTOR, ZERO, apply, broadcast, constant, exp2, if_else, load, pointer, ramp

# exponents of 2 below which a weight is zero, and of which a ratio of weights is cut
_LEAST = -126.0


class _Rows:
    """The arguments of a loop over rows, as LLVM values."""

    def __init__(self, context: Any, builder: Any, argument_types: Any, arguments: Any) -> None:
        self.builder = builder
        self.channels, self.first, self.last = arguments[2:5]
        self.run = arguments[7]
        self.pixels = pointer(context, builder, argument_types[0], arguments[0], arguments[1])
        self.colors = pointer(context, builder, argument_types[8], arguments[8], arguments[9])
        self.cutoff = broadcast(builder, arguments[10])
        self.masks = pointer(context, builder, argument_types[11], arguments[11], arguments[12])
        self.is_masked = builder.icmp_signed(">=", arguments[12], ZERO)
        self.is_rgb = builder.icmp_signed("==", self.channels, ir.Constant(LONG, 3))
        shape = pointer(context, builder, argument_types[5], arguments[5], arguments[6])
        k = [broadcast(builder, builder.load(builder.gep(shape, [ir.Constant(LONG, i)]))) for i in range(6)]
        self.z1 = apply(builder, "fma", k[1], ramp(), k[0])
        self.negative = builder.fneg(builder.fmul(self.z1, self.z1))
        self.base = apply(builder, "fma", k[3], ramp(), k[2])
        self.slope, self.change = k[4:]
        self.ratio = builder.fadd(self.change, constant(1.0))

    def specialize(self, emit: Callable[[Channels, bool], None]) -> None:
        """Emit the code for three channels and for any number, with a mask and without."""

        def emit_channels(is_rgb: bool) -> None:
            channels = Channels(self.builder, self.colors, self.channels, is_rgb)
            if_else(self.builder, self.is_masked, lambda masked: emit(channels, masked))

        if_else(self.builder, self.is_rgb, emit_channels)

    @contextmanager
    def each_row(self, masked: bool) -> Iterator[tuple[Any, Any, Any]]:
        """Emit a loop over the rows; yield z2, weight, and pointer to the pixels."""
        builder = self.builder
        y, weight, growth = (cgutils.alloca_once(builder, VECTOR) for _ in range(3))
        first = builder.fadd(builder.sitofp(self.first, FLOAT), ir.Constant(FLOAT, -(SIDE - 1) / 2))
        builder.store(broadcast(builder, first), y)
        with cgutils.for_range_slice(builder, self.first, self.last, self.run) as (start, _):
            self._begin(self._second(builder.load(y)), weight, growth)
            end = builder.add(start, self.run)
            end = builder.select(builder.icmp_signed("<", end, self.last), end, self.last)
            with cgutils.for_range_slice(builder, start, end, ir.Constant(LONG, 1)) as (row, _):
                w, g = builder.load(weight), builder.load(growth)
                value = builder.select(builder.fcmp_ordered(">=", w, self.cutoff), w, constant(0.0))
                if masked:
                    place = builder.gep(self.masks, [builder.mul(row, ir.Constant(LONG, SIDE))])
                    value = builder.fmul(value, load(builder, place))
                step = builder.mul(self.channels, ir.Constant(LONG, SIDE))
                yield self._second(builder.load(y)), value, builder.gep(self.pixels, [builder.mul(row, step)])
                builder.store(builder.fadd(builder.load(y), constant(1.0)), y)
                builder.store(apply(builder, "fma", w, g, w), weight)
                builder.store(apply(builder, "fma", g, self.ratio, self.change), growth)

    def _second(self, y: Any) -> Any:
        """Return z2 of a row, whose distance from the middle of the block is y."""
        return apply(self.builder, "fma", self.slope, y, self.base)

    def _begin(self, second: Any, weight: Any, growth: Any) -> None:
        """Set the weights of a row, and by what share of them those of the next are more."""
        builder = self.builder
        exponent = apply(builder, "fma", builder.fneg(second), second, self.negative)
        is_normal = builder.fcmp_ordered(">=", exponent, constant(_LEAST))
        builder.store(builder.select(is_normal, exp2(builder, exponent), constant(0.0)), weight)
        twice = builder.fadd(builder.fadd(second, second), self.slope)
        exponent = apply(builder, "minnum", builder.fmul(builder.fneg(self.slope), twice), constant(-_LEAST))
        builder.store(exp2(builder, exponent, minus_one=True), growth)


# types of origin, channels, first and last row
_ROW_TYPES = (types.int64,) * 4


@intrinsic
def add_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, origin, channels, first, last, shapes, shape_start, run, colors, color_start, cutoff, masks,
    mask_start,
):  # fmt: skip
    """pixels[row, c, :] += weight[row, :] * colors[c] for rows first ... last - 1."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _Rows(context, builder, signature.args, arguments)

        def emit(channels: Channels, masked: bool) -> None:
            with rows.each_row(masked) as (_, weight, pixels):
                channels.add(weight, pixels)

        rows.specialize(emit)
        return context.get_dummy_value()

    long = types.int64
    return types.void(pixels, *_ROW_TYPES, shapes, long, long, colors, long, types.float32, masks, long), generate


@intrinsic
def gather_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, origin, channels, first, last, shapes, shape_start, run, colors, color_start, cutoff, masks,
    mask_start, sums, terms, place,
):  # fmt: skip
    """Set the terms from `place` on to sums over rows and columns: w g_c for every channel c, then, with
    v = w sum_c g_c colors_c, of v z1, v z2, v z1 z1, v z1 z2, v z2 z2; `sums`, float32, is room for them times SIDE."""  # noqa: D205, D209

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _Rows(context, builder, signature.args, arguments)
        room = pointer(context, builder, signature.args[13], arguments[13], ZERO)
        target = pointer(context, builder, signature.args[14], *arguments[14:])

        def emit(channels: Channels, masked: bool) -> None:
            total = Sums(channels, room)
            with rows.each_row(masked) as (second, weight, pixels):
                total.gather(weight, pixels, second)
            total.finish(rows.z1, target)

        rows.specialize(emit)
        return context.get_dummy_value()

    long = types.int64
    kinds = pixels, *_ROW_TYPES, shapes, long, long, colors, long, types.float32, masks, long, sums, terms, long
    return types.void(*kinds), generate
