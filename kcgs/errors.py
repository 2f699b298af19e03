"""Errors that name the argument; they survive pickling, so that worker processes can raise them.

A command replaces the name of the argument by that of its option. Errors of the content of files, and of an argument
that must do something else than be, have or hold, are a plain `ValueError` or `TypeError`.
"""

from __future__ import annotations


class _ArgumentError(Exception):
    """Names an argument, what it must be, and what it was.

    Args:
        name: of the argument.
        expected: what it must be, or what follows another verb.
        received: what it was, as the message shows it.
        verb: between name and expectation, "be", "have" or "hold".
    """

    def __init__(self, name: str, expected: str, received: object, verb: str = "be") -> None:
        super().__init__(name, expected, received, verb)
        self.name = name
        self.expected = expected
        self.received = received
        self.verb = verb

    def __str__(self) -> str:
        return f"{self.name} must {self.verb} {self.expected}; got {self.received}"


class InvalidArgument(_ArgumentError, ValueError):
    """A ValueError with the name of an argument, what it must be, and what it was.

    Example:
        >>> str(InvalidArgument("count", "at least 1", 0))
        'count must be at least 1; got 0'
    """


class InvalidArgumentType(_ArgumentError, TypeError):
    """A TypeError with the name of an argument, what it must be, and what it was."""
