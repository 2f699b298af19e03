"""constriction's range coder behind two classes, so that one procedure describes both writing and reading.

Probabilities reach it as float64 that both sides compute by the same sums, products and quotients.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .errors import CodecError
from .exact import Floats

Integers = NDArray[np.int64]

ONE = 1 << 16  # chances are whole multiples of 1 / ONE
_WINDOW = 64  # bits of the coder's state
_MOST = 1 << 16  # largest alphabet of equally likely numbers
_LEAST = 64  # chance of a Counter's bit
_AT_ONCE = 1 << 12
_FEW = 16  # symbols among which the library finds one faster by trying all than by a table
_FOREIGN = "data must be an encoder's stream; got bytes that no encoder wrote"


class Coder(Protocol):
    """Either side of a stream: what is written is returned, so is what is read; a reader ignores the values."""

    reads: bool

    def bits(self, chances: Any, values: Any) -> Any:
        """Code bits that are 1 with these chances: (n,) float64 in whole 1 / ONE, and int32."""

    def number(self, value: int, size: int) -> int:
        """Code one of 0 to size - 1, all equally likely; size is at most 2**16."""

    def uniform(self, sizes: Integers, values: Integers | None) -> Integers:
        """Code values of 0 to size - 1 (n,), all equally likely; sizes are below 2**24."""

    def choose(self, tables: Floats, rows: Integers, values: Integers | None) -> Integers:
        """Code values (n,) by tables of weights, (T, A); each by the one that its entry of `rows` (n,) names."""

    def repeat(self, table: Floats, count: int, values: Integers | None) -> Integers:
        """Code `count` values by one table of weights, (A,)."""

    def numbers(self, values: Any, size: int, count: int) -> Any:
        """Code that many, (count,) int32; size is 2 to 2**24."""


class Writer:
    """Turns symbols into bytes."""

    reads = False

    def __init__(self) -> None:
        self._encoder, self._models = _queue().RangeEncoder(), _models()
        # constriction rounds chances to 1/2**24: whole 1 / ONE are exact
        self._bernoulli = self._models.Bernoulli(perfect=True)

    def bits(self, chances: Any, values: Any) -> Any:
        """Write bits."""
        self._encoder.encode(values, self._bernoulli, chances)
        return values

    def number(self, value: int, size: int) -> int:
        """Write a number."""
        if size > 1:
            self._encoder.encode(value, self._models.Uniform(size))
        return value

    def uniform(self, sizes: Integers, values: Integers | None) -> Integers:
        """Write values that are equally likely."""
        assert values is not None
        told = sizes > 1  # a size of one says nothing, and the library knows none
        if told.any():
            self._encoder.encode(values[told].astype(np.int32), self._models.Uniform(), sizes[told].astype(np.int32))
        return values

    def choose(self, tables: Floats, rows: Integers, values: Integers | None) -> Integers:
        """Write values by a table each."""
        assert values is not None
        if len(tables) == 1:
            return self.repeat(tables[0], len(rows), values)
        models = [self._models.Categorical(table, perfect=False) for table in tables]
        for value, row in zip(values.tolist(), rows.tolist(), strict=True):
            self._encoder.encode(value, models[row])
        return values

    def repeat(self, table: Floats, count: int, values: Integers | None) -> Integers:
        """Write values by one table."""
        assert values is not None
        if count:
            self._encoder.encode(values.astype(np.int32), self._models.Categorical(table, perfect=False))
        return values

    def numbers(self, values: Any, size: int, count: int) -> Any:
        """Write numbers."""
        self._encoder.encode(values, self._models.Uniform(size))
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


class Reader:
    """Turns bytes into symbols; zeros follow the last byte."""

    reads = True

    def __init__(self, data: bytes) -> None:
        padded = data + bytes(-len(data) % 4)
        self._decoder = _queue().RangeDecoder(np.frombuffer(padded, ">u4").astype(np.uint32))
        self._models = _models()
        self._bernoulli = self._models.Bernoulli(perfect=True)

    def bits(self, chances: Any, values: Any) -> Any:
        """Read bits."""
        return self._decode(self._bernoulli, chances)

    def number(self, value: int, size: int) -> int:
        """Read a number."""
        return int(self._decode(self._models.Uniform(size))) if size > 1 else 0

    def uniform(self, sizes: Integers, values: Integers | None) -> Integers:
        """Read values that are equally likely."""
        found = np.zeros(len(sizes), np.int64)
        told = np.flatnonzero(sizes > 1)
        if len(told):
            found[told] = self._decode(self._models.Uniform(), sizes[told].astype(np.int32))
        return found

    def choose(self, tables: Floats, rows: Integers, values: Integers | None) -> Integers:
        """Read values by a table each."""
        if len(tables) == 1:
            return self.repeat(tables[0], len(rows), values)
        # one by one, since the library makes a model anew for each row of many tables
        models, decode = [self._models.Categorical(table, perfect=False) for table in tables], self._decoder.decode
        try:
            return np.array([decode(models[row]) for row in rows.tolist()], np.int64)
        except AssertionError:
            raise CodecError(_FOREIGN) from None

    def repeat(self, table: Floats, count: int, values: Integers | None) -> Integers:
        """Read values by one table."""
        if not count:
            return np.zeros(0, np.int64)
        model = self._models.Categorical(table, lazy=len(table) < _FEW, perfect=False)
        return np.asarray(self._decode(model, count), np.int64)

    def numbers(self, values: Any, size: int, count: int) -> Any:
        """Read numbers."""
        return self._decode(self._models.Uniform(size), count)

    def _decode(self, *model: Any) -> Any:
        try:
            return self._decoder.decode(*model)
        except AssertionError:
            raise CodecError(_FOREIGN) from None


def batches(count: int) -> list[slice]:
    """Cut so many rows into parts whose tables fit into memory."""
    return [slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE)]


def _queue() -> Any:
    import constriction

    return constriction.stream.queue


def _models() -> Any:
    import constriction

    return constriction.stream.model


class Counter:
    """A bit whose chance is learnt while it is coded: it starts at `ones` of 4."""

    def __init__(self, ones: int) -> None:
        self._ones, self._all = ones, 4

    def code(self, coder: Coder, value: bool) -> bool:
        """Code the bit."""
        chance = min(max(self._ones * ONE // self._all, _LEAST), ONE - _LEAST)
        bit = bool(coder.bits(np.array([chance / ONE]), np.array([value], np.int32))[0])
        self._ones += 2 * bit
        self._all += 2
        return bit


def fair(coder: Coder, value: bool) -> bool:
    """Code a bit that is as likely 0 as 1."""
    return bool(coder.number(int(value), 2))


def plain(coder: Coder, value: int, count: int) -> int:
    """Code the low `count` bits of a number, 16 at a time, lowest first."""
    result = 0
    for shift in range(0, count, 16):
        size = 1 << min(16, count - shift)
        result |= coder.number(value >> shift & (size - 1), size) << shift
    return result


def uniform(coder: Coder, value: int, size: int) -> int:
    """Code one of 0 to size - 1, all about equally likely: what exceeds 16 bits, then 16 bits."""
    if size <= _MOST:
        return coder.number(value, size)
    high = uniform(coder, value >> 16, -(-size >> 16))
    return high << 16 | coder.number(value & (_MOST - 1), _MOST)


def magnitude(coder: Coder, value: int) -> int:
    """Code a number below 2**63 whose size is unknown: its count of bits, then those below the highest."""
    length = coder.number(value.bit_length(), 64)
    return 1 << (length - 1) | plain(coder, value, length - 1) if length else 0
