"""The inner loops of the CPU kernel as explicit vector code: a row of a tile, 16 pixels, at a time.

LLVM does not vectorise these loops by itself, but splits vectors of 16 float32 into what the processor has. The
pixels of a tile lie in memory as [row][channel][column].
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

SIDE = 16  # of a tile, and elements of a vector
_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_LONG = ir.IntType(64)
_VECTOR = ir.VectorType(_FLOAT, SIDE)
_VECTOR_INT = ir.VectorType(_INT, SIDE)
_START = ir.Constant(_LONG, 0)


def exp2_coefficients(degree: int = 5) -> list[float]:
    """Polynomial for 2^f on [-1/2, 1/2] that is exactly 1 at 0, lowest power first."""
    nodes = 0.5 * np.cos((np.arange(64) + 0.5) * np.pi / 64)
    rest = np.polynomial.Chebyshev.fit(nodes, (np.exp2(nodes) - 1) / nodes, degree - 1, domain=[-0.5, 0.5])
    return [1.0, *rest.convert(kind=np.polynomial.Polynomial).coef.tolist()]


EXP2 = exp2_coefficients()


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, float(np.float32(value)))] * SIDE)


def _call(builder: Any, name: str, *arguments: Any) -> Any:
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * len(arguments)), f"llvm.{name}.v{SIDE}f32"
    )
    return builder.call(function, arguments)


def _broadcast(builder: Any, value: Any) -> Any:
    single = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(single, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_VECTOR_INT, None))


def _ramp() -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, column - (SIDE - 1) / 2) for column in range(SIDE)])


def _exp2(builder: Any, exponent: Any) -> Any:
    exponent = _call(builder, "maxnum", exponent, _constant(-126.0))
    whole = _call(builder, "rint", exponent)
    rest = builder.fsub(exponent, whole)
    value = _constant(EXP2[-1])
    for coefficient in reversed(EXP2[:-1]):
        value = _call(builder, "fma", value, rest, _constant(coefficient))
    bits = builder.shl(
        builder.add(builder.fptosi(whole, _VECTOR_INT), ir.Constant(_VECTOR_INT, [127] * SIDE)),
        ir.Constant(_VECTOR_INT, [23] * SIDE),
    )
    return builder.fmul(value, builder.bitcast(bits, _VECTOR))


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


def _row(builder: Any, pointer: Any, index: Any) -> Any:
    """Return the pointer to a vector `index` vectors further on."""
    start = builder.gep(pointer, [builder.mul(index, ir.Constant(_LONG, SIDE))])
    return builder.bitcast(start, _VECTOR.as_pointer())


def _load(builder: Any, pointer: Any, index: Any = _START) -> Any:
    return builder.load(_row(builder, pointer, index), align=4)


def _store(builder: Any, value: Any, pointer: Any, index: Any = _START) -> None:
    builder.store(value, _row(builder, pointer, index), align=4)


class _Columns:
    """A Gaussian over the columns of a tile: its whitened coordinates, and its weight along a row."""

    def __init__(self, builder: Any, coefficients: Any, lowest: Any) -> None:
        self.builder = builder
        k = [builder.load(builder.gep(coefficients, [ir.Constant(_LONG, i)])) for i in range(5)]
        column = _ramp()
        first = _call(builder, "fma", _broadcast(builder, k[1]), column, _broadcast(builder, k[0]))
        self.first = first
        self.negative = builder.fneg(builder.fmul(first, first))
        self.base = _call(builder, "fma", _broadcast(builder, k[3]), column, _broadcast(builder, k[2]))
        self.slope = _broadcast(builder, k[4])
        self.lowest = _broadcast(builder, lowest)

    def weight(self, row: Any, mask: Any) -> tuple[Any, Any]:
        """Second coordinate and weight; `row` counts from the middle of the tile, `mask` is a pointer or None."""
        builder = self.builder
        second = _call(builder, "fma", self.slope, _broadcast(builder, row), self.base)
        exponent = _call(builder, "fma", builder.fneg(second), second, self.negative)
        seen = builder.fcmp_ordered(">=", exponent, self.lowest)
        weight = builder.select(seen, _exp2(builder, exponent), _constant(0.0))
        if mask is not None:
            weight = builder.fmul(weight, _load(builder, mask))
        return second, weight


class _Call:
    """The arguments that both loops share, as LLVM values."""

    def __init__(self, context: Any, builder: Any, types_of: Any, arguments: Any) -> None:
        self.builder = builder
        self.channels = arguments[-1]
        self.first, self.last = arguments[2:4]
        self.pixels = _pointer(context, builder, types_of[0], arguments[0], arguments[1])
        coefficients = _pointer(context, builder, types_of[4], arguments[4], _START)
        self.colors = _pointer(context, builder, types_of[6], arguments[6], arguments[7])
        self.masks = _pointer(context, builder, types_of[8], arguments[8], arguments[9])
        self.masked = builder.icmp_signed(">=", arguments[9], _START)
        self.geometry = _Columns(builder, coefficients, arguments[5])

    @contextmanager
    def each_row(self, masked: bool) -> Iterator[tuple[Any, Any, Any]]:
        """Emit a loop over the rows; yield second coordinate, weight, and pointer to the pixels."""
        builder = self.builder
        with cgutils.for_range_slice(builder, self.first, self.last, ir.Constant(_LONG, 1)) as (row, _):
            start = builder.mul(row, ir.Constant(_LONG, SIDE))
            mask = builder.gep(self.masks, [start]) if masked else None
            middle = builder.fadd(builder.sitofp(row, _FLOAT), ir.Constant(_FLOAT, -(SIDE - 1) / 2))
            second, weight = self.geometry.weight(middle, mask)
            yield second, weight, builder.gep(self.pixels, [builder.mul(start, self.channels)])

    def color(self, channel: Any) -> Any:
        """Return a color in all elements of a vector."""
        return _broadcast(self.builder, self.builder.load(self.builder.gep(self.colors, [channel])))


def _both(builder: Any, condition: Any, emit: Callable[[bool], None]) -> None:
    with builder.if_else(condition) as (then, otherwise):
        with then:
            emit(True)
        with otherwise:
            emit(False)


@intrinsic
def add_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, offset, first, last, coefficients, lowest, colors, color_at, masks, mask_at, channels
):
    """pixels[row, c, :] += weight[row, :] * colors[c] for rows first ... last - 1; mask_at < 0: no mask."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Call(context, builder, signature.args, arguments)

        def emit(masked: bool) -> None:
            with call.each_row(masked) as (_, weight, pixels), cgutils.for_range(builder, call.channels) as loop:
                value = _call(builder, "fma", weight, call.color(loop.index), _load(builder, pixels, loop.index))
                _store(builder, value, pixels, loop.index)

        _both(builder, call.masked, emit)
        return context.get_dummy_value()

    long = types.int64
    return types.void(pixels, long, long, long, coefficients, types.float32, colors, long, masks, long, long), generate


@intrinsic
def gather_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, offset, first, last, coefficients, lowest, colors, color_at, masks, mask_at, sums, moments,
    channels,
):  # fmt: skip
    """Add to sums[k, column] over rows: w g_c for every channel c, then, with v = w sum_c g_c colors_c and where
    `moments` is true, v z1, v z2, v z1 z1, v z1 z2, v z2 z2."""  # noqa: D205, D209

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Call(context, builder, signature.args, arguments)
        sums_at = _pointer(context, builder, signature.args[10], arguments[10], _START)

        def emit(masked: bool, moments: bool) -> None:
            # variables, which LLVM keeps in registers
            totals = [cgutils.alloca_once_value(builder, _constant(0.0)) for _ in range(3 if moments else 0)]
            with call.each_row(masked) as (second, weight, pixels):
                # -0.0 added changes nothing, not even the sign of a zero
                value = cgutils.alloca_once_value(builder, _constant(-0.0))
                with cgutils.for_range(builder, call.channels) as loop:
                    c = loop.index
                    grad = _load(builder, pixels, c)
                    _store(builder, _call(builder, "fma", weight, grad, _load(builder, sums_at, c)), sums_at, c)
                    if moments:
                        builder.store(_call(builder, "fma", grad, call.color(c), builder.load(value)), value)
                if moments:
                    moment = builder.fmul(builder.load(value), weight)
                    along = builder.fmul(moment, second)
                    total, first, square = (builder.load(total) for total in totals)
                    builder.store(builder.fadd(total, moment), totals[0])
                    builder.store(builder.fadd(first, along), totals[1])
                    builder.store(_call(builder, "fma", along, second, square), totals[2])
            if moments:
                _add_moments(call, [builder.load(total) for total in totals], sums_at)

        _both(builder, call.masked, lambda masked: _both(builder, arguments[11], lambda moments: emit(masked, moments)))
        return context.get_dummy_value()

    long = types.int64
    return types.void(
        pixels, long, long, long, coefficients, types.float32, colors, long, masks, long, sums, types.boolean, long
    ), generate


def _add_moments(call: _Call, sums: list[Any], sums_at: Any) -> None:
    # z1 is the same in every row of the tile: it multiplies the sums, not the terms
    builder, first = call.builder, call.geometry.first
    total, along, square = sums
    once = builder.fmul(total, first)
    for k, term in enumerate([once, along, builder.fmul(once, first), builder.fmul(along, first), square]):
        at = builder.add(call.channels, ir.Constant(_LONG, k))
        _store(builder, builder.fadd(_load(builder, sums_at, at), term), sums_at, at)


@intrinsic
def copy(typing_context, target, target_at, source, source_at, count):  # type: ignore[no-untyped-def]
    """Copy elements; a constant number becomes vector code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, start = (_pointer(context, builder, signature.args[i], *arguments[i : i + 2]) for i in (0, 2))
        cgutils.raw_memcpy(builder, to, start, arguments[4], 4)
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64, types.int64), generate


@intrinsic
def sum_columns(typing_context, sums, index):  # type: ignore[no-untyped-def]
    """Sum of the sixteen columns of row `index`, in a fixed order."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = builder.mul(arguments[1], ir.Constant(_LONG, SIDE))
        value = _load(builder, _pointer(context, builder, signature.args[0], arguments[0], start))
        width = SIDE
        while width > 1:
            width //= 2
            kind = ir.VectorType(_INT, width)
            low, high = (ir.Constant(kind, list(range(start, start + width))) for start in (0, width))
            nothing = ir.Constant(value.type, ir.Undefined)
            value = builder.fadd(
                builder.shuffle_vector(value, nothing, low), builder.shuffle_vector(value, nothing, high)
            )
        return builder.extract_element(value, ir.Constant(_INT, 0))

    return types.float32(sums, types.int64), generate
