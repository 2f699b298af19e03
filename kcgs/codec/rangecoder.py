"""The range coder of constriction behind two classes, so that one procedure describes both writing and reading.

docs/format.md specifies the symbols of a stream.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from .exact import Floats, Integers

ONE = 1 << 16  # a chance of 1: chances are whole multiples of 1 / ONE
_STATE_BITS = 64  # bits of the coder's state
_DIGIT = 1 << 16  # largest alphabet of `number`: larger numbers are coded in parts
_LAZY_SIZE = 16  # alphabet below which constriction is faster by search than by a table


class CodecError(ValueError):
    """A stream is damaged, or is not of this format."""


class Coder(ABC):
    """One side of a stream: a writer codes values and returns them, a reader ignores them and returns decoded values.

    So one procedure both writes and reads; a reader passes any values of the right shape.
    """

    is_reader = False

    def __init__(self) -> None:
        import constriction

        self._queue, self._models = constriction.stream.queue, constriction.stream.model
        # constriction rounds chances to 1 / 2**24, so whole 1 / ONE are exact
        self._bernoulli = self._models.Bernoulli(perfect=True)

    @abstractmethod
    def _code(self, values: Any, model: Any, *parameters: Any, count: int | None = None) -> Any:
        """Code by a model: one value, or a value for each entry of the parameters, or `count` values."""

    def bits(self, chances: Any, values: Any) -> Any:
        """Code bits (n,) int32 that are 1 with these chances (n,), float64 in whole 1 / ONE."""
        return self._code(values, self._bernoulli, chances)

    def number(self, value: int, size: int) -> int:
        """Code a number below `size`: the bits above the low 16, then the low 16."""
        if size > _DIGIT:
            high = self.number(value >> 16, -(-size >> 16))
            return high << 16 | self.number(value & (_DIGIT - 1), _DIGIT)
        return int(self._code(value, self._models.Uniform(size))) if size > 1 else 0

    def fair_bit(self, value: bool) -> bool:
        """Code a bit that is 0 or 1 with equal chances."""
        return bool(self.number(int(value), 2))

    def plain_bits(self, value: int, count: int) -> int:
        """Code the low `count` bits of a number, 16 at a time, lowest first."""
        result = 0
        for shift in range(0, count, 16):
            size = 1 << min(16, count - shift)
            result |= self.number(value >> shift & (size - 1), size) << shift
        return result

    def unbounded_number(self, value: int) -> int:
        """Code a number below 2**63: its count of bits, then the bits below the highest."""
        length = self.number(value.bit_length(), 64)
        return 1 << (length - 1) | self.plain_bits(value, length - 1) if length else 0

    def numbers(self, values: Any, size: int, count: int) -> Any:
        """Code `count` numbers (count,) int32 below `size`, which is 2 to 2**24."""
        return self._code(values, self._models.Uniform(size), count=count)

    def uniform(self, sizes: Integers, values: Integers) -> Integers:
        """Code values (n,), each below its entry of `sizes` (n,), which is 1 to 2**24 - 1."""
        coded = np.zeros(len(sizes), np.int64)
        index = np.flatnonzero(sizes > 1)  # constriction has no alphabet of one symbol
        if len(index):
            numbers, model = values[index].astype(np.int32), self._models.Uniform()
            coded[index] = self._code(numbers, model, sizes[index].astype(np.int32))
        return coded

    def categorical(self, weights: Floats, values: Integers) -> Integers:
        """Code values (n,) by one table of weights (A,)."""
        if not len(values):
            return np.zeros(0, np.int64)
        symbols = self._code(values.astype(np.int32), self._categorical(weights), count=len(values))
        return np.asarray(symbols, np.int64)

    def mixed_categorical(self, tables: Floats, rows: Integers, values: Integers) -> Integers:
        """Code values (n,), each with the row of `tables` (T, A) at its entry of `rows` (n,)."""
        if len(tables) == 1:
            return self.categorical(tables[0], values)
        # one by one: constriction would build a model for each value
        models = {row: self._categorical(tables[row]) for row in np.unique(rows).tolist()}
        pairs = zip(values.tolist(), rows.tolist(), strict=True)
        return np.array([self._code(symbol, models[row]) for symbol, row in pairs], np.int64)

    def _categorical(self, weights: Floats) -> Any:
        return self._models.Categorical(weights, lazy=len(weights) < _LAZY_SIZE, perfect=False)


class Writer(Coder):
    """Turn symbols into bytes."""

    def __init__(self) -> None:
        super().__init__()
        self._encoder = self._queue.RangeEncoder()

    def _code(self, values: Any, model: Any, *parameters: Any, count: int | None = None) -> Any:
        self._encoder.encode(values, model, *parameters)
        return values

    def finish(self) -> bytes:
        """Return the fewest bytes that a reader, which sees zeros after them, decodes to the symbols."""
        position, (lower, width) = self._encoder.pos()
        length = 4 * position + _STATE_BITS // 8
        words: bytes = self._encoder.get_compressed().astype(">u4").tobytes()
        value = int.from_bytes(words[:length].ljust(length, b"\0"), "big")
        # all values from `low` to below `low + width` decode to the same symbols; constriction chose `value`
        low = value - ((value - lower) % (1 << _STATE_BITS))
        # the width is below 2**64: rstrip removes zeros beyond 8
        for zeros in range(min(length, _STATE_BITS // 8), -1, -1):
            step = 1 << (8 * zeros)
            value = -(-low // step) * step
            if value < low + width:
                break
        return value.to_bytes(length, "big").rstrip(b"\0")


class Reader(Coder):
    """Turn bytes into symbols; zeros follow the last byte."""

    is_reader = True

    def __init__(self, data: bytes) -> None:
        super().__init__()
        padded = data + bytes(-len(data) % 4)
        self._decoder = self._queue.RangeDecoder(np.frombuffer(padded, ">u4").astype(np.uint32))

    def _code(self, values: Any, model: Any, *parameters: Any, count: int | None = None) -> Any:
        try:
            return self._decoder.decode(model, *(parameters if count is None else (count,)))
        except AssertionError:
            raise CodecError("data must be an encoder's stream; got bytes that no encoder wrote") from None
