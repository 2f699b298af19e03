"""constriction's range coder behind two classes, so that one procedure describes both writing and reading.

The symbols and how they share a stream are specified in docs/format.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from .exact import Floats, Integers

ONE = 1 << 16  # chances are whole multiples of 1 / ONE
_WINDOW = 64  # bits of the coder's state
_ALPHABET = 1 << 16  # largest alphabet of equally likely numbers
_FEW = 16  # symbols among which the library finds one faster by trying all than by a table


class CodecError(ValueError):
    """A stream that is damaged, or no stream of this format."""


class Coder(ABC):
    """Either side of a stream: what is written is returned, so is what is read; a reader ignores the values."""

    reads = False

    def __init__(self) -> None:
        import constriction

        self._queue, self._models = constriction.stream.queue, constriction.stream.model
        # constriction rounds chances to 1/2**24: whole 1 / ONE are exact
        self._bernoulli = self._models.Bernoulli(perfect=True)

    @abstractmethod
    def _code(self, values: Any, model: Any, *parameters: Any, count: int | None = None) -> Any:
        """Code by a model: one value, or one for each entry of the parameters, or `count` of them."""

    def bits(self, chances: Any, values: Any) -> Any:
        """Code bits that are 1 with these chances: (n,) float64 in whole 1 / ONE, and int32."""
        return self._code(values, self._bernoulli, chances)

    def number(self, value: int, size: int) -> int:
        """Code one of 0 to size - 1, all about equally likely: what exceeds 16 bits, then 16 bits."""
        if size > _ALPHABET:
            high = self.number(value >> 16, -(-size >> 16))
            return high << 16 | self.number(value & (_ALPHABET - 1), _ALPHABET)
        return int(self._code(value, self._models.Uniform(size))) if size > 1 else 0

    def fair(self, value: bool) -> bool:
        """Code a bit that is as likely 0 as 1."""
        return bool(self.number(int(value), 2))

    def plain(self, value: int, count: int) -> int:
        """Code the low `count` bits of a number, 16 at a time, lowest first."""
        result = 0
        for shift in range(0, count, 16):
            size = 1 << min(16, count - shift)
            result |= self.number(value >> shift & (size - 1), size) << shift
        return result

    def unbounded(self, value: int) -> int:
        """Code a number below 2**63 that nothing is known of: its count of bits, then those below the highest."""
        length = self.number(value.bit_length(), 64)
        return 1 << (length - 1) | self.plain(value, length - 1) if length else 0

    def numbers(self, values: Any, size: int, count: int) -> Any:
        """Code that many, (count,) int32, of 0 to size - 1, all equally likely; size is 2 to 2**24."""
        return self._code(values, self._models.Uniform(size), count=count)

    def uniform(self, sizes: Integers, values: Integers | None) -> Integers:
        """Code values of 0 to size - 1 (n,), all equally likely; sizes are below 2**24."""
        found = np.zeros(len(sizes), np.int64)
        several = np.flatnonzero(sizes > 1)  # a size of one says nothing, and the library knows none
        if len(several):
            given = None if values is None else values[several].astype(np.int32)
            found[several] = self._code(given, self._models.Uniform(), sizes[several].astype(np.int32))
        return found

    def repeat(self, table: Floats, count: int, values: Integers | None) -> Integers:
        """Code `count` values by one table of weights, (A,)."""
        if not count:
            return np.zeros(0, np.int64)
        given = None if values is None else values.astype(np.int32)
        return np.asarray(self._code(given, self._categorical(table), count=count), np.int64)

    def choose(self, tables: Floats, rows: Integers, values: Integers | None) -> Integers:
        """Code values (n,) by tables of weights, (T, A); each by the one that its entry of `rows` (n,) names."""
        if len(tables) == 1:
            return self.repeat(tables[0], len(rows), values)
        # one by one, since the library makes a model anew for each row of many tables
        models, code = {row: self._categorical(tables[row]) for row in np.unique(rows).tolist()}, self._code
        given = [None] * len(rows) if values is None else values.tolist()
        return np.array([code(v, models[row]) for v, row in zip(given, rows.tolist(), strict=True)], np.int64)

    def _categorical(self, table: Floats) -> Any:
        return self._models.Categorical(table, lazy=len(table) < _FEW, perfect=False)


class Writer(Coder):
    """Turns symbols into bytes."""

    def __init__(self) -> None:
        super().__init__()
        self._encoder = self._queue.RangeEncoder()

    def _code(self, values: Any, model: Any, *parameters: Any, count: int | None = None) -> Any:
        assert values is not None
        self._encoder.encode(values, model, *parameters)
        return values

    def finish(self) -> bytes:
        """Return the fewest bytes that, with zeros behind them, read as what was written."""
        position, (lower, width) = self._encoder.pos()
        length = 4 * position + _WINDOW // 8
        words: bytes = self._encoder.get_compressed().astype(">u4").tobytes()
        value = int.from_bytes(words[:length].ljust(length, b"\0"), "big")
        # all values from `low` for `width` read the same; this one was constriction's choice
        low = value - ((value - lower) % (1 << _WINDOW))
        # the width is below 2**64: more zeros than that come by themselves
        for zeros in range(min(length, _WINDOW // 8), -1, -1):
            step = 1 << (8 * zeros)
            value = -(-low // step) * step
            if value < low + width:
                break
        return value.to_bytes(length, "big").rstrip(b"\0")


class Reader(Coder):
    """Turns bytes into symbols; zeros follow the last byte."""

    reads = True

    def __init__(self, data: bytes) -> None:
        super().__init__()
        padded = data + bytes(-len(data) % 4)
        self._decoder = self._queue.RangeDecoder(np.frombuffer(padded, ">u4").astype(np.uint32))

    def _code(self, values: Any, model: Any, *parameters: Any, count: int | None = None) -> Any:
        try:
            return self._decoder.decode(model, *(parameters if count is None else (count,)))
        except AssertionError:
            raise CodecError("data must be an encoder's stream; got bytes that no encoder wrote") from None
