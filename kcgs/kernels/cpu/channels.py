"""Vector code for the channels of a row of pixels, for `rows`: add weight times colour, or sum gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils

from .simd import LONG, apply, broadcast, constant, load, store


class Channels:
    """Code for every channel; three channels have no loop, and their sums stay in registers."""

    def __init__(self, builder: Any, colors: Any, count: Any, stride: Any, is_rgb: bool) -> None:
        self.builder, self.colors, self.count, self.stride, self.is_rgb = builder, colors, count, stride, is_rgb

    def each(self, emit: Callable[[Any, Any], None], pixels: Any) -> None:
        """Call emit(channel, pointer to its pixels), within a loop or for each of three."""

        def visit(channel: Any) -> None:
            emit(channel, self.builder.gep(pixels, [self.builder.mul(channel, self.stride)]))

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

    def __init__(self, channels: Channels, sums: Any, moments: int) -> None:
        builder = self.builder = channels.builder
        self.channels, self.sums = channels, sums
        zero = constant(0.0)
        self.totals = [cgutils.alloca_once_value(builder, zero) for _ in range(3 if channels.is_rgb else 0)]
        # variables, which LLVM keeps in registers
        self.moments = [cgutils.alloca_once_value(builder, zero) for _ in range(moments)]

    def gather(self, weight: Any, pixels: Any) -> Any:
        """Add w g_c; return w sum_c g_c colors_c."""
        builder = self.builder
        # -0.0 added changes nothing, not even the sign of a zero
        value = cgutils.alloca_once_value(builder, constant(-0.0))

        def gather_channel(channel: Any, place: Any) -> None:
            grad = load(builder, place)
            if self.totals:
                total = self.totals[channel.constant]
                builder.store(apply(builder, "fma", weight, grad, builder.load(total)), total)
            else:
                total = apply(builder, "fma", weight, grad, load(builder, self.sums, channel))
                store(builder, total, self.sums, channel)
            if self.moments:
                builder.store(apply(builder, "fma", grad, self.channels.color(channel), builder.load(value)), value)

        self.channels.each(gather_channel, pixels)
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
            terms.append((builder.add(self.channels.count, ir.Constant(LONG, k)), moment))
        for index, term in terms:
            store(builder, builder.fadd(load(builder, self.sums, index), term), self.sums, index)
