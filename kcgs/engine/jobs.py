"""A job, and what became of it: the part that runs wherever the job does."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import torch

Result = TypeVar("Result")


class Failure(NamedTuple):
    """Why there is no result."""

    type: str
    """Name of the exception's class; WorkerDied where the process itself ended."""
    message: str
    traceback: str
    """As Python prints it; empty where a process ended without one."""

    def __str__(self) -> str:
        return f"{self.type}: {' '.join(self.message.split())}" if self.message else self.type


@dataclass(frozen=True)
class Done(Generic[Result]):
    """A job that has ended, with a result or with an error."""

    index: int
    """Of the job among those that were given."""
    result: Result | None
    error: Failure | None
    seconds: float
    """Wall time of the job, measured where it ran."""


def perform(index: int, call: Callable[[], Result], threads: int) -> Done[Result]:
    """Do a job on so many threads; what it raises becomes a Failure."""
    # the CPU kernel goes by torch's number too; numba is told none of its own, since no loop is parallel by itself
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    start = time.perf_counter()
    result, error = None, None
    try:
        result = call()
    except Exception as raised:
        error = describe(raised)
    finally:
        seconds = time.perf_counter() - start
        torch.set_num_threads(before)
    return Done(index, result, error, seconds)


def describe(raised: BaseException) -> Failure:
    """Put an exception into words, which travel between processes where exceptions may not."""
    return Failure(type(raised).__name__, str(raised), "".join(traceback.format_exception(raised)))


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set variables that processes started meanwhile inherit."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
