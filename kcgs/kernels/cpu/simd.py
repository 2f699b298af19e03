"""The inner loops of the CPU kernel as explicit vector code: a row of a tile, 16 pixels, at a time.

LLVM does not vectorise these loops by itself, but splits vectors of 16 float32 into what the processor has. The
pixels of a tile lie in memory as [row][channel][column].
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
START = ir.Constant(LONG, 0)
NOTHING = ir.Constant(VECTOR, ir.Undefined)


def exp2_coefficients(degree: int = 5) -> list[float]:
    """Polynomial for 2^f on [-1/2, 1/2] that is exactly 1 at 0, lowest power first."""
    nodes = 0.5 * np.cos((np.arange(64) + 0.5) * np.pi / 64)
    rest = np.polynomial.Chebyshev.fit(nodes, (np.exp2(nodes) - 1) / nodes, degree - 1, domain=[-0.5, 0.5])
    return [1.0, *rest.convert(kind=np.polynomial.Polynomial).coef.tolist()]


EXP2 = exp2_coefficients()


def constant(value: float) -> ir.Constant:
    """A number in all elements of a vector."""
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, float(np.float32(value)))] * SIDE)


def apply(builder: Any, name: str, *arguments: Any) -> Any:
    """Call the LLVM function of this name on vectors."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(VECTOR, [VECTOR] * len(arguments)), f"llvm.{name}.v{SIDE}f32"
    )
    return builder.call(function, arguments)


def broadcast(builder: Any, value: Any) -> Any:
    """A value in all elements of a vector."""
    single = builder.insert_element(NOTHING, value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(single, NOTHING, ir.Constant(_VECTOR_INT, None))


def ramp() -> ir.Constant:
    """Columns of the vector, counted from its middle."""
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, column - (SIDE - 1) / 2) for column in range(SIDE)])


def exp2(builder: Any, exponent: Any) -> Any:
    """Two to the power of a vector: a polynomial between whole exponents."""
    exponent = apply(builder, "maxnum", exponent, constant(-126.0))
    whole = apply(builder, "rint", exponent)
    rest = builder.fsub(exponent, whole)
    value = constant(EXP2[-1])
    for coefficient in reversed(EXP2[:-1]):
        value = apply(builder, "fma", value, rest, constant(coefficient))
    bits = builder.shl(
        builder.add(builder.fptosi(whole, _VECTOR_INT), ir.Constant(_VECTOR_INT, [127] * SIDE)),
        ir.Constant(_VECTOR_INT, [23] * SIDE),
    )
    return builder.fmul(value, builder.bitcast(bits, VECTOR))


def pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    """Where element `offset` of an array lies."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


def _row(builder: Any, pointer: Any, index: Any) -> Any:
    """Return the pointer to a vector `index` vectors further on."""
    start = builder.gep(pointer, [builder.mul(index, ir.Constant(LONG, SIDE))])
    return builder.bitcast(start, VECTOR.as_pointer())


def load(builder: Any, pointer: Any, index: Any = START) -> Any:
    """Load vector `index` from a pointer on."""
    return builder.load(_row(builder, pointer, index), align=4)


def store(builder: Any, value: Any, pointer: Any, index: Any = START) -> None:
    """Store vector `index` from a pointer on."""
    builder.store(value, _row(builder, pointer, index), align=4)


def shuffle(builder: Any, first: Any, second: Any, places: Sequence[int]) -> Any:
    """Return the elements at `places` of two vectors, the first's before the second's."""
    kind = ir.VectorType(_INT, len(places))
    return builder.shuffle_vector(first, second, ir.Constant(kind, [ir.Constant(_INT, place) for place in places]))


def both(builder: Any, condition: Any, emit: Callable[[bool], None]) -> None:
    """Emit both branches of a condition."""
    with builder.if_else(condition) as (then, otherwise):
        with then:
            emit(True)
        with otherwise:
            emit(False)


@intrinsic
def copy(typing_context, target, target_at, source, source_at, count):  # type: ignore[no-untyped-def]
    """Copy elements; a constant number becomes vector code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to, start = (pointer(context, builder, signature.args[i], *arguments[i : i + 2]) for i in (0, 2))
        cgutils.raw_memcpy(builder, to, start, arguments[4], 4)
        return context.get_dummy_value()

    return types.void(target, types.int64, source, types.int64, types.int64), generate


@intrinsic
def clear_rows(typing_context, target, at, stride, count):  # type: ignore[no-untyped-def]
    """Set `count` rows of 16, each `stride` after the last, to zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = pointer(context, builder, signature.args[0], *arguments[:2])
        with cgutils.for_range(builder, arguments[3]) as loop:
            store(builder, constant(0.0), builder.gep(start, [builder.mul(loop.index, arguments[2])]))
        return context.get_dummy_value()

    long = types.int64
    return types.void(target, long, long, long), generate


@intrinsic
def sum_columns(typing_context, sums, count, out, at):  # type: ignore[no-untyped-def]
    """out[at + k] = the sum of the sixteen columns of sums[k], in a fixed order, eight k at a time.

    Both arrays have room for a multiple of eight.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source = pointer(context, builder, signature.args[0], arguments[0], START)
        target = pointer(context, builder, signature.args[2], arguments[2], arguments[3])
        eight = ir.Constant(LONG, 8)
        groups = builder.sdiv(builder.add(arguments[1], ir.Constant(LONG, 7)), eight)
        with cgutils.for_range(builder, groups) as loop:
            first = builder.mul(loop.index, eight)
            rows = [load(builder, source, builder.add(first, ir.Constant(LONG, k))) for k in (0, 4, 2, 6, 1, 5, 3, 7)]
            # halves of two rows are put side by side and added, until one row holds two columns of each
            width = SIDE
            while len(rows) > 1:
                rows = [_fold(builder, rows[k], rows[k + 1], width) for k in range(0, len(rows), 2)]
                width //= 2
            total = builder.fadd(*(shuffle(builder, rows[0], NOTHING, range(k, SIDE, 2)) for k in (0, 1)))
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
    return builder.fadd(*(shuffle(builder, one, other, place) for place in places))
