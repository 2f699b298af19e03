"""Vector code for the channels of a row of pixels, for `rows`: add weight times colour, or sum gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from kcgs._numba_internals import cgutils

from .simd import SIDE, apply, broadcast, constant, load, long, store, sum_columns

# number of sums over rows: of v, v z2, v z2 z2
_MOMENTS = 3
# number of sums over rows and columns: of v z1, v z2, v z1 z1, v z1 z2, v z2 z2
_TERMS = 5


class Channels:
    """Code for every channel; three channels have no loop, and their sums stay in registers."""

    def __init__(self, builder: Any, colors: Any, count: Any, is_rgb: bool) -> None:
        self.builder, self.colors, self.count, self.is_rgb = builder, colors, count, is_rgb

    def each(self, emit: Callable[[Any, Any], None], pixels: Any) -> None:
        """Call emit(channel, pointer to its pixels) in a loop over channels, or three times for RGB."""

        def visit(channel: Any) -> None:
            emit(channel, self.builder.gep(pixels, [self.builder.mul(channel, long(SIDE))]))

        if self.is_rgb:
            for c in range(3):
                visit(long(c))
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
    """Sums over rows and columns: w g_c of each channel, then the moments of v = w sum_c g_c colors_c.

    `room` has a vector for each sum. Within half of the columns, registers hold the sums of RGB and the moments.
    """

    def __init__(self, channels: Channels, room: Any) -> None:
        builder = self.builder = channels.builder
        self.channels, self.room = channels, room
        # variables, which LLVM keeps in registers
        zero = constant(0.0)
        self.totals = [cgutils.alloca_once(builder, zero.type) for _ in range(3 if channels.is_rgb else 0)]
        self.moments = [cgutils.alloca_once(builder, zero.type) for _ in range(_MOMENTS)]
        self.count = long(3 + _TERMS) if channels.is_rgb else builder.add(channels.count, long(_TERMS))
        # eight vectors at a time, as in `finish`: LLVM would turn a loop over single vectors into a call of memset
        with cgutils.for_range_slice(builder, long(0), self.count, long(8)) as (first, _):
            for k in range(8):
                store(builder, zero, room, builder.add(first, long(k)))

    def begin(self) -> None:
        """Begin half of the columns."""
        for total in (*self.totals, *self.moments):
            self.builder.store(constant(0.0), total)

    def gather(self, weight: Any, pixels: Any, second: Any) -> None:
        """Add the terms of a row of pixels, whose z2 is `second`."""
        builder = self.builder
        # -0.0 added changes nothing, not even the sign of a zero
        product = cgutils.alloca_once_value(builder, constant(-0.0))

        def gather_channel(channel: Any, place: Any) -> None:
            grad = load(builder, place)
            if self.totals:
                self._add(self.totals[channel.constant], weight, grad)
            else:
                total = apply(builder, "fma", weight, grad, load(builder, self.room, channel))
                store(builder, total, self.room, channel)
            self._add(product, grad, self.channels.color(channel))

        self.channels.each(gather_channel, pixels)
        value = builder.fmul(builder.load(product), weight)
        along = builder.fmul(value, second)
        for total, term in zip(self.moments, (value, along), strict=False):
            builder.store(builder.fadd(builder.load(total), term), total)
        self._add(self.moments[2], along, second)

    def _add(self, total: Any, first: Any, second: Any) -> None:
        self.builder.store(apply(self.builder, "fma", first, second, self.builder.load(total)), total)

    def end(self, z1: Any) -> None:
        """End half of the columns; z1, the same in every row, multiplies the sums, not the terms."""
        builder = self.builder
        value, along, square = (builder.load(total) for total in self.moments)
        first = builder.fmul(value, z1)
        moments = [first, along, builder.fmul(first, z1), builder.fmul(along, z1), square]
        places = [long(k) for k in range(len(self.totals))]
        places += [builder.add(self.channels.count, long(k)) for k in range(_TERMS)]
        for place, total in zip(places, [*map(builder.load, self.totals), *moments], strict=True):
            store(builder, builder.fadd(load(builder, self.room, place), total), self.room, place)

    def finish(self, terms: Any) -> None:
        """Store the sums over columns."""
        builder = self.builder
        with cgutils.for_range_slice(builder, long(0), self.count, long(8)) as (row, _):
            rows = [load(builder, self.room, builder.add(row, long(k))) for k in range(8)]
            total, place = sum_columns(builder, rows), builder.gep(terms, [row])
            builder.store(total, builder.bitcast(place, total.type.as_pointer()), align=4)
