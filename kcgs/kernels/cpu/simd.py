"""Vectors of 16 float32, a row of a tile, in LLVM: what the code of `rows` and `spline` is written with.

LLVM does not vectorise these loops by itself, but splits such vectors into those of the processor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

SIDE = 16  # of a tile, and elements of a vector
FLOAT = ir.FloatType()
_INT = ir.IntType(32)
LONG = ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, SIDE)
_VECTOR_INT = ir.VectorType(_INT, SIDE)
ZERO = ir.Constant(LONG, 0)
UNDEFINED = ir.Constant(VECTOR, ir.Undefined)


def exp2_coefficients(degree: int = 5) -> list[float]:
    """Return a polynomial for 2^f on [-1/2, 1/2] that is exactly 1 at 0, lowest power first."""
    nodes = 0.5 * np.cos((np.arange(64) + 0.5) * np.pi / 64)
    quotient = np.polynomial.Chebyshev.fit(nodes, (np.exp2(nodes) - 1) / nodes, degree - 1, domain=[-0.5, 0.5])
    return [1.0, *quotient.convert(kind=np.polynomial.Polynomial).coef.tolist()]


EXP2 = exp2_coefficients()


def constant(value: float) -> ir.Constant:
    """Return a number in all elements of a vector."""
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, float(np.float32(value)))] * SIDE)


def apply(builder: Any, name: str, *arguments: Any) -> Any:
    """Call the LLVM function of this name on vectors."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(VECTOR, [VECTOR] * len(arguments)), f"llvm.{name}.v{SIDE}f32"
    )
    return builder.call(function, arguments)


def broadcast(builder: Any, value: Any) -> Any:
    """Return a value in all elements of a vector."""
    single = builder.insert_element(UNDEFINED, value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(single, UNDEFINED, ir.Constant(_VECTOR_INT, None))


def ramp() -> ir.Constant:
    """Return the columns of a vector, counted from its middle."""
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, column - (SIDE - 1) / 2) for column in range(SIDE)])


def exp2(builder: Any, exponent: Any) -> Any:
    """Return 2 to the power of a vector: a polynomial between whole exponents."""
    exponent = apply(builder, "maxnum", exponent, constant(-126.0))
    whole = apply(builder, "rint", exponent)
    fraction = builder.fsub(exponent, whole)
    value = constant(EXP2[-1])
    for coefficient in reversed(EXP2[:-1]):
        value = apply(builder, "fma", value, fraction, constant(coefficient))
    bits = builder.shl(
        builder.add(builder.fptosi(whole, _VECTOR_INT), ir.Constant(_VECTOR_INT, [127] * SIDE)),
        ir.Constant(_VECTOR_INT, [23] * SIDE),
    )
    return builder.fmul(value, builder.bitcast(bits, VECTOR))


def pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    """Return the pointer to element `offset` of an array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


def _row(builder: Any, pointer: Any, index: Any) -> Any:
    """Return the pointer to a vector `index` vectors further on."""
    start = builder.gep(pointer, [builder.mul(index, ir.Constant(LONG, SIDE))])
    return builder.bitcast(start, VECTOR.as_pointer())


def load(builder: Any, pointer: Any, index: Any = ZERO) -> Any:
    """Load vector `index` from a pointer on."""
    return builder.load(_row(builder, pointer, index), align=4)


def store(builder: Any, value: Any, pointer: Any, index: Any = ZERO) -> None:
    """Store vector `index` from a pointer on."""
    builder.store(value, _row(builder, pointer, index), align=4)


def shuffle(builder: Any, first: Any, second: Any, places: Sequence[int]) -> Any:
    """Return the elements at `places` of two vectors, the first's before the second's."""
    kind = ir.VectorType(_INT, len(places))
    return builder.shuffle_vector(first, second, ir.Constant(kind, [ir.Constant(_INT, place) for place in places]))


def if_else(builder: Any, condition: Any, emit: Callable[[bool], None]) -> None:
    """Emit both branches of a condition: emit(True) where it holds, emit(False) elsewhere."""
    with builder.if_else(condition) as (then, otherwise):
        with then:
            emit(True)
        with otherwise:
            emit(False)


@intrinsic
def copy(typing_context, target, target_start, source, source_start, count):  # type: ignore[no-untyped-def]
    """Copy `count` elements of four bytes from element `source_start` to element `target_start`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, start = (pointer(context, builder, signature.args[i], *arguments[i : i + 2]) for i in (0, 2))
        cgutils.raw_memcpy(builder, to, start, arguments[4], 4)
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64, types.int64), generate


@intrinsic
def clear_rows(typing_context, target, origin, stride, count):  # type: ignore[no-untyped-def]
    """Set `count` rows of 16 from element `origin` on, `stride` elements apart, to zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = pointer(context, builder, signature.args[0], *arguments[:2])
        with cgutils.for_range(builder, arguments[3]) as loop:
            store(builder, constant(0.0), builder.gep(start, [builder.mul(loop.index, arguments[2])]))
        return context.get_dummy_value()

    long = types.int64
    return types.void(target, long, long, long), generate


@intrinsic
def sum_columns(typing_context, sums, count, terms, start):  # type: ignore[no-untyped-def]
    """Set terms[start + k] to the sum of the 16 columns of sums[k], for k < count, in a fixed order.

    Eight k are done at a time: both arrays have room for a multiple of eight.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source = pointer(context, builder, signature.args[0], arguments[0], ZERO)
        target = pointer(context, builder, signature.args[2], arguments[2], arguments[3])
        eight = ir.Constant(LONG, 8)
        groups = builder.sdiv(builder.add(arguments[1], ir.Constant(LONG, 7)), eight)
        with cgutils.for_range(builder, groups) as loop:
            first = builder.mul(loop.index, eight)
            rows = [load(builder, source, builder.add(first, ir.Constant(LONG, k))) for k in (0, 4, 2, 6, 1, 5, 3, 7)]
            # the halves of two rows are interleaved and added, until one row holds two columns of each
            width = SIDE
            while len(rows) > 1:
                rows = [_fold(builder, rows[k], rows[k + 1], width) for k in range(0, len(rows), 2)]
                width //= 2
            total = builder.fadd(*(shuffle(builder, rows[0], UNDEFINED, range(k, SIDE, 2)) for k in (0, 1)))
            place = builder.bitcast(builder.gep(target, [first]), total.type.as_pointer())
            builder.store(total, place, align=4)
        return context.get_dummy_value()

    return types.void(sums, types.int64, terms, types.int64), generate


def _fold(builder: Any, first: Any, second: Any, width: int) -> Any:
    """Add the halves of every group of `width` elements of two vectors, the first's and the second's in turn."""
    half = width // 2
    places = [
        [SIDE * side + group + shift + k for group in range(0, SIDE, width) for side in (0, 1) for k in range(half)]
        for shift in (0, half)
    ]
    return builder.fadd(*(shuffle(builder, first, second, place) for place in places))
