"""Vector code over the rows of a block that a Gaussian touches: it adds the Gaussian, or gathers its gradients.

Along a column the weight follows from row to row by two products, w <- w g and g <- g c, since its exponent is a
polynomial of degree two. The code stores g - 1 and c - 1, which are small where a Gaussian is wide, so that errors do
not grow. Each run of rows begins with exponentials, and is so short that no weight within the ellipse underflows; each
row of a thin Gaussian is a run. The loop visits the left half of the columns first, then the right half.

Arguments in common:

- pixels, origin: float32 array, and the first element of the block, [SIDE rows][channel][SIDE columns];
- channels: their number;
- pairs, number: Lists.pairs, and the row of the pair;
- shapes, colors, cutoff: see Lists;
- masks, mask_start: float32 array of membership, and the block's first element, negative for a block without a mask.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba import types
from numba.extending import intrinsic

from kcgs._numba_internals import cgutils

from .channels import Channels, Sums
from .layout import (
    END_HALF,
    FIRST,
    FIRST_HALF,
    GAUSSIAN,
    LAST,
    PAIR_COLUMNS,
    PREFETCH_DISTANCE,
    RUN,
    SHAPE_COLUMNS,
    TERMS,
)
from .simd import (
    HALF,
    LONG,
    SIDE,
    VECTOR,
    apply,
    broadcast,
    constant,
    exp2,
    if_else,
    load,
    long,
    pointer,
    prefetch,
    ramp,
)

# a weight below 2^_LEAST is zero, and a ratio of weights is at most 2^-_LEAST
_LEAST = -126.0


class _PairRows:
    """The arguments of a loop over rows, as LLVM values."""

    def __init__(self, context: Any, builder: Any, argument_types: Any, arguments: Any) -> None:
        self.builder = builder
        self.channels = arguments[2]
        pixels, pairs, shapes, colors, masks = (
            pointer(context, builder, argument_types[k], arguments[k], offset)
            for k, offset in ((0, arguments[1]), (3, long(0)), (5, long(0)), (6, long(0)), (8, arguments[9]))
        )

        def field(column: int, ahead: int = 0) -> Any:
            place = builder.mul(builder.add(arguments[4], long(ahead)), long(PAIR_COLUMNS))
            return builder.sext(builder.load(builder.gep(pairs, [builder.add(place, long(column))])), LONG)

        self.first, self.last, self.run = field(FIRST), field(LAST), field(RUN)
        self.first_half, self.end_half = field(FIRST_HALF), field(END_HALF)
        self.terms = field(TERMS)
        self.pixels, self.masks = pixels, masks
        self.colors = builder.gep(colors, [builder.mul(field(GAUSSIAN), self.channels)])
        self.cutoff = broadcast(builder, arguments[7])
        self.is_masked = builder.icmp_signed(">=", arguments[9], long(0))
        self.is_rgb = builder.icmp_signed("==", self.channels, long(3))
        prefetch(builder, builder.gep(shapes, [builder.mul(field(TERMS, PREFETCH_DISTANCE), long(SHAPE_COLUMNS))]))
        shape = builder.gep(shapes, [builder.mul(self.terms, long(SHAPE_COLUMNS))])
        self.shape = [broadcast(builder, builder.load(builder.gep(shape, [long(k)]))) for k in range(SHAPE_COLUMNS)]
        self.slope, self.change, self.first_y = self.shape[4:]
        self.ratio = builder.fadd(self.change, constant(1.0))

    def specialize(self, emit: Callable[[Channels, bool], None]) -> None:
        """Emit the code for three channels and for any number, with a mask and without."""

        def emit_channels(is_rgb: bool) -> None:
            channels = Channels(self.builder, self.colors, self.channels, is_rgb)
            if_else(self.builder, self.is_masked, lambda masked: emit(channels, masked))

        if_else(self.builder, self.is_rgb, emit_channels)

    @contextmanager
    def each_half(self) -> Iterator[Any]:
        """Emit a loop over the halves of the columns; yield the half."""
        builder = self.builder
        with cgutils.for_range_slice(builder, self.first_half, self.end_half, long(1)) as (half, _):
            k = self.shape
            # constants, since a conversion from integers waits for the register that the previous loop used last
            columns = builder.select(builder.icmp_signed("==", half, long(0)), ramp(0), ramp(1))
            self.z1 = apply(builder, "fma", k[1], columns, k[0])
            self.negative = builder.fneg(builder.fmul(self.z1, self.z1))
            self.base = apply(builder, "fma", k[3], columns, k[2])
            yield half

    @contextmanager
    def each_row(self, half: Any, masked: bool) -> Iterator[tuple[Any, Any, Any]]:
        """Emit a loop over the rows of half of the columns; yield z2, weight, and pointer to the pixels."""
        builder = self.builder
        y, weight, growth = (cgutils.alloca_once(builder, VECTOR) for _ in range(3))
        builder.store(self.first_y, y)
        column = builder.mul(half, long(HALF))
        with cgutils.for_range_slice(builder, self.first, self.last, self.run) as (start, _):
            self._begin(self._second(builder.load(y)), weight, growth)
            end = builder.add(start, self.run)
            end = builder.select(builder.icmp_signed("<", end, self.last), end, self.last)
            with cgutils.for_range_slice(builder, start, end, long(1)) as (row, _):
                w, g = builder.load(weight), builder.load(growth)
                value = builder.select(builder.fcmp_ordered(">=", w, self.cutoff), w, constant(0.0))
                place = builder.mul(row, long(SIDE))
                if masked:
                    mask = builder.gep(self.masks, [builder.add(place, column)])
                    value = builder.fmul(value, load(builder, mask))
                place = builder.add(builder.mul(place, self.channels), column)
                yield self._second(builder.load(y)), value, builder.gep(self.pixels, [place])
                builder.store(builder.fadd(builder.load(y), constant(1.0)), y)
                builder.store(apply(builder, "fma", w, g, w), weight)
                builder.store(apply(builder, "fma", g, self.ratio, self.change), growth)

    def _second(self, y: Any) -> Any:
        """Return z2 of a row, whose distance from the middle of the block is y."""
        return apply(self.builder, "fma", self.slope, y, self.base)

    def _begin(self, second: Any, weight: Any, growth: Any) -> None:
        """Set the weights of a row, and their growth: the ratio of the next row's weights to them, minus 1."""
        builder = self.builder
        exponent = apply(builder, "fma", builder.fneg(second), second, self.negative)
        is_normal = builder.fcmp_ordered(">=", exponent, constant(_LEAST))
        builder.store(builder.select(is_normal, exp2(builder, exponent), constant(0.0)), weight)
        twice = builder.fadd(builder.fadd(second, second), self.slope)
        exponent = apply(builder, "minnum", builder.fmul(builder.fneg(self.slope), twice), constant(-_LEAST))
        builder.store(exp2(builder, exponent, minus_one=True), growth)


@intrinsic
def add_rows(typing_context, pixels, origin, channels, pairs, number, shapes, colors, cutoff, masks, mask_start):
    """Add a pair: pixels[row, c, :] += weight[row, :] * colors[c] for its rows."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _PairRows(context, builder, signature.args, arguments)

        def emit(channels: Channels, masked: bool) -> None:
            with rows.each_half() as half, rows.each_row(half, masked) as (_, weight, pixels):
                channels.add(weight, pixels)

        rows.specialize(emit)
        return context.get_dummy_value()

    return types.void(*_common_types(pixels, pairs, shapes, colors, masks)), generate


@intrinsic
def gather_rows(
    typing_context, pixels, origin, channels, pairs, number, shapes, colors, cutoff, masks, mask_start, sums, terms,
    columns,
):  # fmt: skip
    """Set a pair's terms to sums over its pixels: of w g_c per channel c, and of v (z1, z2, z1 z1, z1 z2, z2 z2).

    v is w sum_c g_c colors_c; a row of `terms` has so many `columns`; `sums`, float32, is room for as many vectors.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = _PairRows(context, builder, signature.args, arguments)
        room = pointer(context, builder, signature.args[10], arguments[10], long(0))
        target = pointer(context, builder, signature.args[11], arguments[11], builder.mul(rows.terms, arguments[12]))

        def emit(channels: Channels, masked: bool) -> None:
            total = Sums(channels, room)
            with rows.each_half() as half:
                total.begin()
                with rows.each_row(half, masked) as (second, weight, pixels):
                    total.gather(weight, pixels, second)
                total.end(rows.z1)
            total.finish(target)

        rows.specialize(emit)
        return context.get_dummy_value()

    kinds = _common_types(pixels, pairs, shapes, colors, masks)
    return types.void(*kinds, sums, terms, types.int64), generate


def _common_types(pixels: Any, pairs: Any, shapes: Any, colors: Any, masks: Any) -> tuple[Any, ...]:
    """Return the types of the arguments in common."""
    number = types.int64
    return pixels, number, number, pairs, number, shapes, colors, types.float32, masks, number
