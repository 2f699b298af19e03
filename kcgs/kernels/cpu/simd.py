"""The inner loops of the CPU kernel as explicit vector code: a row of a tile, 16 pixels, at a time.

LLVM does not vectorise these loops by itself, but splits vectors of 16 float32 into what the processor has. Each loop
has a scalar twin in `scalar.py` with the same arguments. The pixels of a tile lie in memory as [row][channel][column].
"""

from __future__ import annotations

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


def _load(builder: Any, pointer: Any, step: int = 0) -> Any:
    start = builder.gep(pointer, [ir.Constant(_LONG, step * SIDE)])
    return builder.load(builder.bitcast(start, _VECTOR.as_pointer()), align=4)


def _store(builder: Any, value: Any, pointer: Any, step: int = 0) -> None:
    start = builder.gep(pointer, [ir.Constant(_LONG, step * SIDE)])
    builder.store(value, builder.bitcast(start, _VECTOR.as_pointer()), align=4)


class _Columns:
    """A Gaussian over the columns of a tile: its whitened coordinates, and its weight along a row."""

    def __init__(self, builder: Any, coefficients: Any, lowest: Any) -> None:
        self.builder = builder
        k = [_element(builder, coefficients, i) for i in range(5)]
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


def _element(builder: Any, pointer: Any, index: int) -> Any:
    return builder.load(builder.gep(pointer, [ir.Constant(_LONG, index)]))


def _middle(builder: Any, row: Any) -> Any:
    return builder.fadd(builder.sitofp(row, _FLOAT), ir.Constant(_FLOAT, -(SIDE - 1) / 2))


class _Call:
    """The arguments that both loops share, as LLVM values."""

    def __init__(self, context: Any, builder: Any, types_of: Any, arguments: Any) -> None:
        start = ir.Constant(_LONG, 0)
        self.builder = builder
        self.channels = types_of[-1].count
        self.first, self.last = arguments[2:4]
        self.step = ir.Constant(_LONG, 1)
        self.pixels = _pointer(context, builder, types_of[0], arguments[0], arguments[1])
        coefficients = _pointer(context, builder, types_of[4], arguments[4], start)
        colors = _pointer(context, builder, types_of[6], arguments[6], arguments[7])
        self.masks = _pointer(context, builder, types_of[8], arguments[8], arguments[9])
        self.plain = builder.icmp_signed("<", arguments[9], start)
        self.colors = [_broadcast(builder, _element(builder, colors, c)) for c in range(self.channels)]
        self.geometry = _Columns(builder, coefficients, arguments[5])

    def at_row(self, row: Any, masked: bool) -> tuple[Any, Any, Any]:
        """Second coordinate, weight, and pointer to the pixels of a row."""
        builder = self.builder
        mask = builder.gep(self.masks, [builder.mul(row, ir.Constant(row.type, SIDE))]) if masked else None
        second, weight = self.geometry.weight(_middle(builder, row), mask)
        return second, weight, builder.gep(self.pixels, [builder.mul(row, ir.Constant(row.type, SIDE * self.channels))])

    def each_kind(self, emit: Any) -> None:
        """Emit a loop for rows without a mask, and one for rows with one."""
        with self.builder.if_else(self.plain) as (then, otherwise):
            with then:
                emit(False)
            with otherwise:
                emit(True)


@intrinsic
def add_rows(  # type: ignore[no-untyped-def]
    typing_context, pixels, offset, first, last, coefficients, lowest, colors, color_at, masks, mask_at, tag
):
    """pixels[row, c, :] += weight[row, :] * colors[c] for rows first ... last - 1; mask_at < 0: no mask."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Call(context, builder, signature.args, arguments)

        def emit(masked: bool) -> None:
            with cgutils.for_range_slice(builder, call.first, call.last, call.step) as (row, _):
                _, weight, pixels = call.at_row(row, masked)
                for c, color in enumerate(call.colors):
                    _store(builder, _call(builder, "fma", weight, color, _load(builder, pixels, c)), pixels, c)

        call.each_kind(emit)
        return context.get_dummy_value()

    long = types.int64
    return types.void(pixels, long, long, long, coefficients, types.float32, colors, long, masks, long, tag), generate


@intrinsic
def gather_rows(  # type: ignore[no-untyped-def]
    typing_context,
    pixels,
    offset,
    first,
    last,
    coefficients,
    lowest,
    colors,
    color_at,
    masks,
    mask_at,
    sums,
    moments,
    tag,
):
    """Add to sums[k, column] over rows: w g_c for every channel c, then, with v = w sum_c g_c colors_c and where
    `moments` is true, v z1, v z2, v z1 z1, v z1 z2, v z2 z2."""  # noqa: D205, D209

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        call = _Call(context, builder, signature.args, arguments)
        sums_at = _pointer(context, builder, signature.args[10], arguments[10], ir.Constant(_LONG, 0))

        def emit(masked: bool, moments: bool) -> None:
            start = [_load(builder, sums_at, c) for c in range(call.channels)]
            start += [_constant(0.0)] * 3 if moments else []
            # variables, which LLVM keeps in registers
            totals = [cgutils.alloca_once_value(builder, value) for value in start]
            with cgutils.for_range_slice(builder, call.first, call.last, call.step) as (row, _):
                second, weight, pixels = call.at_row(row, masked)
                grads = [_load(builder, pixels, c) for c in range(call.channels)]
                sums = [builder.load(total) for total in totals]
                following = [_call(builder, "fma", weight, g, total) for g, total in zip(grads, sums, strict=False)]
                if moments:
                    value = builder.fmul(grads[0], call.colors[0])
                    for g, color in zip(grads[1:], call.colors[1:], strict=True):
                        value = _call(builder, "fma", g, color, value)
                    value = builder.fmul(value, weight)
                    moment = builder.fmul(value, second)
                    total, along, square = sums[call.channels :]
                    following += [builder.fadd(total, value), builder.fadd(along, moment)]
                    following.append(_call(builder, "fma", moment, second, square))
                for total, value in zip(totals, following, strict=True):
                    builder.store(value, total)
            final = [builder.load(total) for total in totals]
            for c in range(call.channels):
                _store(builder, final[c], sums_at, c)
            if moments:
                _add_moments(builder, call.geometry.first, final[call.channels :], sums_at, call.channels)

        def both(masked: bool) -> None:
            with builder.if_else(arguments[11]) as (then, otherwise):
                with then:
                    emit(masked, True)
                with otherwise:
                    emit(masked, False)

        call.each_kind(both)
        return context.get_dummy_value()

    long = types.int64
    return types.void(
        pixels, long, long, long, coefficients, types.float32, colors, long, masks, long, sums, types.boolean, tag
    ), generate


def _add_moments(builder: Any, first: Any, sums: list[Any], sums_at: Any, channels: int) -> None:
    # z1 is the same in every row of the tile: it multiplies the sums, not the terms
    total, along, square = sums
    once = builder.fmul(total, first)
    for k, term in enumerate([once, along, builder.fmul(once, first), builder.fmul(along, first), square]):
        _store(builder, builder.fadd(_load(builder, sums_at, channels + k), term), sums_at, channels + k)


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
