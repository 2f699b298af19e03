"""Vector code for the channels of a row of pixels, for `rows`: add weight times colour, or sum gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils

from .simd import LONG, SIDE, apply, broadcast, constant, load, store, sum_columns

# sums of v, v z2 and v z2 z2
_MOMENTS = 3


class Channels:
    """Code for every channel; three channels have no loop, and their sums stay in registers."""

    def __init__(self, builder: Any, colors: Any, count: Any, is_rgb: bool) -> None:
        self.builder, self.colors, self.count, self.is_rgb = builder, colors, count, is_rgb

    def each(self, emit: Callable[[Any, Any], None], pixels: Any) -> None:
        """Call emit(channel, pointer to its pixels), within a loop or for each of three."""

        def visit(channel: Any) -> None:
            emit(channel, self.builder.gep(pixels, [self.builder.mul(channel, ir.Constant(LONG, SIDE))]))

        if self.is_rgb:
            for c in range(3):
                visit(ir.Constant(LONG, c))
        else:
            with cgutils.for_range(self.builder, self.count) as loop:
                visit(loop.index)

    def color(self, channel: Any) -> Any:
        """Return a channel of the colour in all elements of a vector."""
        return broadcast(self.builder, self.builder.load(self.builder.gep(self.colors, [channel])))

    def add(self, weight: Any, pixels: Any) -> None:
        """Emit pixels[c] += weight * colors[c]."""

        def add_channel(channel: Any, place: Any) -> None:
            value = apply(self.builder, "fma", weight, self.color(channel), load(self.builder, place))
            store(self.builder, value, place)

        self.each(add_channel, pixels)


class Sums:
    """Sums over rows of 16: w g_c of each channel, then the moments of v = w sum_c g_c colors_c."""

    def __init__(self, channels: Channels, sums: Any) -> None:
        builder = self.builder = channels.builder
        self.channels, self.sums = channels, sums
        zero = constant(0.0)
        # variables, which LLVM keeps in registers
        self.totals = [cgutils.alloca_once_value(builder, zero) for _ in range(3 if channels.is_rgb else 0)]
        self.moments = [cgutils.alloca_once_value(builder, zero) for _ in range(_MOMENTS)]
        if not self.totals:
            with cgutils.for_range(builder, channels.count) as loop:
                store(builder, zero, sums, loop.index)

    def gather(self, weight: Any, pixels: Any, second: Any) -> None:
        """Add the terms of a row of pixels of that weight and z2."""
        builder = self.builder
        # -0.0 added changes nothing, not even the sign of a zero
        product = cgutils.alloca_once_value(builder, constant(-0.0))

        def gather_channel(channel: Any, place: Any) -> None:
            grad = load(builder, place)
            if self.totals:
                self._add(self.totals[channel.constant], weight, grad)
            else:
                total = apply(builder, "fma", weight, grad, load(builder, self.sums, channel))
                store(builder, total, self.sums, channel)
            self._add(product, grad, self.channels.color(channel))

        self.channels.each(gather_channel, pixels)
        value = builder.fmul(builder.load(product), weight)
        along = builder.fmul(value, second)
        for total, term in zip(self.moments, (value, along), strict=False):
            builder.store(builder.fadd(builder.load(total), term), total)
        self._add(self.moments[2], along, second)

    def _add(self, total: Any, first: Any, second: Any) -> None:
        self.builder.store(apply(self.builder, "fma", first, second, self.builder.load(total)), total)

    def finish(self, z1: Any, terms: Any) -> None:
        """Store the sums over columns; z1, the same in every row of a block, multiplies the sums, not the terms."""
        builder = self.builder
        value, along, square = (builder.load(total) for total in self.moments)
        first = builder.fmul(value, z1)
        moments = [first, along, builder.fmul(first, z1), builder.fmul(along, z1), square]
        if self.totals:
            self._store([*(builder.load(total) for total in self.totals), *moments], terms)
            return
        for k, moment in enumerate(moments):
            store(builder, moment, self.sums, builder.add(self.channels.count, ir.Constant(LONG, k)))
        eight = ir.Constant(LONG, 8)
        end = builder.add(self.channels.count, ir.Constant(LONG, len(moments)))
        with cgutils.for_range_slice(builder, ir.Constant(LONG, 0), end, eight) as (row, _):
            rows = [load(builder, self.sums, builder.add(row, ir.Constant(LONG, k))) for k in range(8)]
            self._store(rows, builder.gep(terms, [row]))

    def _store(self, rows: list[Any], terms: Any) -> None:
        total = sum_columns(self.builder, rows)
        self.builder.store(total, self.builder.bitcast(terms, total.type.as_pointer()), align=4)
