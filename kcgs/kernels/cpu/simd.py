"""LLVM operations on vectors of 8 float32, half a row of a tile, for the code of `rows` and `spline`.

LLVM does not vectorise these loops by itself. With vectors as wide as a row, a loop would need more than the sixteen
registers of AVX2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from kcgs._numba_internals import cgutils
from kcgs.maps import TILE

SIDE = TILE
HALF = SIDE // 2  # elements of a vector
HALVES = 2
FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_BYTE = ir.IntType(8).as_pointer()
LONG = ir.IntType(64)
_ZERO = ir.Constant(LONG, 0)
VECTOR = ir.VectorType(FLOAT, HALF)
_VECTOR_INT = ir.VectorType(_INT, HALF)
UNDEFINED = ir.Constant(VECTOR, ir.Undefined)


def exp2_coefficients(degree: int = 6) -> list[float]:
    """Return a polynomial for 2^f on [-1/2, 1/2] that is exactly 1 at 0, lowest power first."""
    nodes = 0.5 * np.cos((np.arange(64) + 0.5) * np.pi / 64)
    quotient = np.polynomial.Chebyshev.fit(nodes, (np.exp2(nodes) - 1) / nodes, degree - 1, domain=[-0.5, 0.5])
    return [1.0, *quotient.convert(kind=np.polynomial.Polynomial).coef.tolist()]


EXP2 = exp2_coefficients()


def long(value: int) -> ir.Constant:
    """Return an integer of 64 bits."""
    return ir.Constant(LONG, value)


def constant(value: float) -> ir.Constant:
    """Return a number in all elements of a vector."""
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, float(np.float32(value)))] * HALF)


def apply(builder: Any, name: str, *arguments: Any) -> Any:
    """Call the LLVM function of this name on vectors."""
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(VECTOR, [VECTOR] * len(arguments)), f"llvm.{name}.v{HALF}f32"
    )
    return builder.call(function, arguments)


def broadcast(builder: Any, value: Any) -> Any:
    """Return a value in all elements of a vector."""
    single = builder.insert_element(UNDEFINED, value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(single, UNDEFINED, ir.Constant(_VECTOR_INT, None))


def ramp(half: int) -> ir.Constant:
    """Return the columns of a vector of a row, counted from the middle of the row."""
    columns = range(half * HALF, half * HALF + HALF)
    return ir.Constant(VECTOR, [ir.Constant(FLOAT, column - (SIDE - 1) / 2) for column in columns])


def exp2(builder: Any, exponent: Any, minus_one: bool = False) -> Any:
    """Return 2^exponent, or 2^exponent - 1, as a whole power of 2 times a polynomial of the fraction."""
    exponent = apply(builder, "maxnum", exponent, constant(-126.0))
    whole = apply(builder, "rint", exponent)
    fraction = builder.fsub(exponent, whole)
    value = constant(EXP2[-1])
    for coefficient in reversed(EXP2[1:-1]):
        value = apply(builder, "fma", value, fraction, constant(coefficient))
    bits = builder.shl(
        builder.add(builder.fptosi(whole, _VECTOR_INT), ir.Constant(_VECTOR_INT, [127] * HALF)),
        ir.Constant(_VECTOR_INT, [23] * HALF),
    )
    power = builder.bitcast(bits, VECTOR)
    if minus_one:  # the first term of the polynomial is 1
        return apply(builder, "fma", builder.fmul(value, fraction), power, builder.fsub(power, constant(1.0)))
    return builder.fmul(apply(builder, "fma", value, fraction, constant(1.0)), power)


def pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    """Return the pointer to element `offset` of an array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


def _row(builder: Any, pointer: Any, index: Any) -> Any:
    """Return the pointer to a vector `index` vectors further on."""
    start = builder.gep(pointer, [builder.mul(index, long(HALF))])
    return builder.bitcast(start, VECTOR.as_pointer())


def load(builder: Any, pointer: Any, index: Any = _ZERO) -> Any:
    """Load the vector that lies `index` vectors after a pointer."""
    return builder.load(_row(builder, pointer, index), align=4)


def store(builder: Any, value: Any, pointer: Any, index: Any = _ZERO) -> None:
    """Store a vector `index` vectors after a pointer."""
    builder.store(value, _row(builder, pointer, index), align=4)


def prefetch(builder: Any, pointer: Any, *, writes: bool = False) -> None:
    """Ask for the line of the cache that holds an address, which will be read, or written."""
    kind = ir.FunctionType(ir.VoidType(), [_BYTE, _INT, _INT, _INT])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
    hints = [ir.Constant(_INT, hint) for hint in (int(writes), 3, 1)]
    builder.call(function, [builder.bitcast(pointer, _BYTE), *hints])


def shuffle(builder: Any, first: Any, second: Any, places: Sequence[int]) -> Any:
    """Return the elements at `places` in the concatenation of two vectors."""
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
def exchange_rows(
    typing_context, image, place, row_stride, channel_stride, pixels, channels, rows, columns, adds, gathers
):
    """Copy a block to an image if it `adds`, from the image if it `gathers`; if both, subtract the image from it.

    The block begins at element `place` of the image and has rows of SIDE elements, [row][channel][column]; its first
    `rows` and `columns` lie within the image.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        image = pointer(context, builder, signature.args[0], *arguments[:2])
        pixels = pointer(context, builder, signature.args[4], arguments[4], long(0))
        row_stride, channel_stride, channels, rows, columns, adds, gathers = (
            arguments[k] for k in (2, 3, *range(5, 10))
        )

        def exchange(inside: Any, outside: Any, subtracts: bool | None) -> None:
            """Copy outward if `subtracts` is None, inward if False; if True, subtract the outside from the inside."""
            if subtracts is None:
                builder.store(builder.load(inside, align=4), outside, align=4)
            elif subtracts:
                builder.store(builder.fsub(*(builder.load(p, align=4) for p in (inside, outside))), inside, align=4)
            else:
                builder.store(builder.load(outside, align=4), inside, align=4)

        def emit(subtracts: bool | None) -> None:
            with cgutils.for_range(builder, rows) as row, cgutils.for_range(builder, channels) as channel:
                first = builder.add(builder.mul(row.index, channels), channel.index)
                inside = builder.gep(pixels, [builder.mul(first, long(SIDE))])
                offset = builder.add(builder.mul(row.index, row_stride), builder.mul(channel.index, channel_stride))
                outside = builder.gep(image, [offset])
                # the end of this row in the next block; the processor does not foresee lines so far apart
                prefetch(builder, builder.gep(outside, [long(2 * SIDE - 1)]), writes=subtracts is None)

                def emit_row(is_whole: bool) -> None:
                    if is_whole:
                        for half in map(long, range(HALVES)):
                            exchange(_row(builder, inside, half), _row(builder, outside, half), subtracts)
                        return
                    with cgutils.for_range(builder, columns) as loop:
                        places = [loop.index]
                        exchange(builder.gep(inside, places), builder.gep(outside, places), subtracts)

                if_else(builder, builder.icmp_signed("==", columns, long(SIDE)), emit_row)

        if_else(builder, gathers, lambda g: if_else(builder, adds, emit) if g else emit(None))
        return context.get_dummy_value()

    number, flag = types.int64, types.boolean
    return types.void(image, *[number] * 3, pixels, *[number] * 3, flag, flag), generate


def sum_columns(builder: Any, rows: Sequence[Any]) -> Any:
    """Return the sum of each of eight vectors, as a vector; the order of addition is fixed."""
    rows = [rows[k] for k in (0, 4, 2, 6, 1, 5, 3, 7)]
    # the halves of two rows are interleaved and added, until one row is left
    width = HALF
    while len(rows) > 1:
        rows = [_fold(builder, rows[k], rows[k + 1], width) for k in range(0, len(rows), 2)]
        width //= 2
    return rows[0]


def _fold(builder: Any, first: Any, second: Any, width: int) -> Any:
    """Add the halves of every group of `width` elements; the groups of the two vectors alternate in the result."""
    half = width // 2
    places = [
        [HALF * side + group + shift + k for group in range(0, HALF, width) for side in (0, 1) for k in range(half)]
        for shift in (0, half)
    ]
    return builder.fadd(*(shuffle(builder, first, second, place) for place in places))
