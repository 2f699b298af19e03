"""One way to write and to read: models that walk the same path with a coder that encodes or decodes.

The range coder is constriction's. Probabilities reach it as float64 that both sides compute by the same sums, products
and quotients.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .errors import CodecError
from .exact import Floats

Integers = NDArray[np.int64]

# the range coder counts in 24 bits
_LARGEST = 1 << 20


class Coder(Protocol):
    """Takes values to write them, or returns those that it reads."""

    def uniform(self, sizes: Integers, values: Integers | None) -> Integers:
        """Code values in [0, size), all as likely; sizes at most 2^20."""

    def choose(self, tables: Floats, values: Integers | None) -> Integers:
        """Code values by a table of weights each [n, A], or one for all [A]."""

    def repeat(self, table: Floats, count: int, values: Integers | None) -> Integers:
        """Code `count` values by one table of weights [A]."""


class Writer:
    """A coder that writes."""

    def __init__(self) -> None:
        self._stream, self._models = _library().RangeEncoder(), _models()

    def uniform(self, sizes: Integers, values: Integers | None) -> Integers:
        """Write values in [0, size)."""
        assert values is not None
        told = sizes > 1  # a size of one says nothing, and the library knows none
        if told.any():
            self._stream.encode(values[told].astype(np.int32), self._models.Uniform(), sizes[told].astype(np.int32))
        return values

    def choose(self, tables: Floats, values: Integers | None) -> Integers:
        """Write values by a table of weights each."""
        assert values is not None
        if len(values):
            self._stream.encode(values.astype(np.int32), self._models.Categorical(perfect=False), tables)
        return values

    def repeat(self, table: Floats, count: int, values: Integers | None) -> Integers:
        """Write values by one table of weights."""
        assert values is not None
        if count:
            self._stream.encode(values.astype(np.int32), self._models.Categorical(table, perfect=False))
        return values

    def finish(self) -> bytes:
        """Return what was written, without the zeros that the reader puts back."""
        words: NDArray[np.uint32] = self._stream.get_compressed()
        return words.astype(">u4").tobytes().rstrip(b"\0")


class Reader:
    """A coder that reads what `Writer` wrote."""

    def __init__(self, data: bytes) -> None:
        padded = data + bytes(-len(data) % 4)
        self._stream = _library().RangeDecoder(np.frombuffer(padded, ">u4").astype(np.uint32))
        self._models = _models()

    def uniform(self, sizes: Integers, values: Integers | None) -> Integers:
        """Read values in [0, size)."""
        found = np.zeros(len(sizes), np.int64)
        told = sizes > 1
        if told.any():
            found[told] = self._read(self._models.Uniform(), sizes[told].astype(np.int32))
        return found

    def choose(self, tables: Floats, values: Integers | None) -> Integers:
        """Read values by a table of weights each."""
        if not len(tables):
            return np.zeros(0, np.int64)
        return self._read(self._models.Categorical(perfect=False), tables)

    def repeat(self, table: Floats, count: int, values: Integers | None) -> Integers:
        """Read values by one table of weights."""
        if not count:
            return np.zeros(0, np.int64)
        return self._read(self._models.Categorical(table, perfect=False), count)

    def _read(self, *arguments: Any) -> Integers:
        try:
            return np.asarray(self._stream.decode(*arguments)).astype(np.int64)
        except AssertionError:
            raise CodecError("the stream does not fit its models") from None


def _library() -> Any:
    import constriction

    return constriction.stream.queue


def _models() -> Any:
    import constriction

    return constriction.stream.model
