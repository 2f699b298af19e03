"""The inner loops of the CPU kernel as explicit vector code: a row of a tile, 16 pixels, at a time.

LLVM does not vectorise these loops by itself, but splits vectors of 16 float32 into what the processor has. The
pixels of a tile lie in memory as [row][channel][column].
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


@intrinsic
def copy(typing_context, target, target_at, source, source_at, count):  # type: ignore[no-untyped-def]
    """Copy elements; a constant number becomes vector code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, start = (_pointer(context, builder, signature.args[i], *arguments[i : i + 2]) for i in (0, 2))
        cgutils.raw_memcpy(builder, to, start, arguments[4], 4)
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64, types.int64), generate


@intrinsic
def clear_rows(typing_context, target, at, stride, count):  # type: ignore[no-untyped-def]
    """Set `count` rows of 16, each `stride` after the last, to zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = _pointer(context, builder, signature.args[0], *arguments[:2])
        with cgutils.for_range(builder, arguments[3]) as loop:
            _store(builder, _constant(0.0), builder.gep(start, [builder.mul(loop.index, arguments[2])]))
        return context.get_dummy_value()

    long = types.int64
    return types.void(target, long, long, long), generate


@intrinsic
def sum_columns(typing_context, sums, count, out, at):  # type: ignore[no-untyped-def]
    """out[at + k] = the sum of the sixteen columns of sums[k], in a fixed order, eight k at a time.

    Both arrays have room for a multiple of eight.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source = _pointer(context, builder, signature.args[0], arguments[0], _START)
        target = _pointer(context, builder, signature.args[2], arguments[2], arguments[3])
        eight = ir.Constant(_LONG, 8)
        groups = builder.sdiv(builder.add(arguments[1], ir.Constant(_LONG, 7)), eight)
        with cgutils.for_range(builder, groups) as loop:
            first = builder.mul(loop.index, eight)
            rows = [_load(builder, source, builder.add(first, ir.Constant(_LONG, k))) for k in (0, 4, 2, 6, 1, 5, 3, 7)]
            # halves of two rows are put side by side and added, until one row holds two columns of each
            width = SIDE
            while len(rows) > 1:
                rows = [_fold(builder, rows[k], rows[k + 1], width) for k in range(0, len(rows), 2)]
                width //= 2
            pairs = ir.VectorType(_INT, 8)
            nothing = ir.Constant(_VECTOR, ir.Undefined)
            parts = [
                builder.shuffle_vector(rows[0], nothing, ir.Constant(pairs, list(range(k, SIDE, 2)))) for k in (0, 1)
            ]
            total = builder.fadd(*parts)
            place = builder.bitcast(builder.gep(target, [first]), total.type.as_pointer())
            builder.store(total, place, align=4)
        return context.get_dummy_value()

    return types.void(sums, types.int64, out, types.int64), generate


def _fold(builder: Any, one: Any, other: Any, width: int) -> Any:
    """Add the halves of every group of `width` elements of two vectors, the first's and the second's in turn."""
    half = width // 2
    places = [
        [SIDE * side + group + shift + k for group in range(0, SIDE, width) for side in (0, 1) for k in range(half)]
        for shift in (0, half)
    ]
    kind = ir.VectorType(_INT, SIDE)
    low, high = (builder.shuffle_vector(one, other, ir.Constant(kind, place)) for place in places)
    return builder.fadd(low, high)
