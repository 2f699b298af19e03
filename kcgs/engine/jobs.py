"""Jobs, what became of them, and the one function that callers use."""

from __future__ import annotations

import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import torch

from kcgs._repr import brief

Job = TypeVar("Job")
Result = TypeVar("Result")

ENGINES = ("local", "ray")


@brief
class Failure(NamedTuple):
    """Why there is no result: WorkerDied, without a traceback, where the process itself ended."""

    type: str
    message: str
    traceback: str

    def __str__(self) -> str:
        return f"{self.type}: {' '.join(self.message.split())}" if self.message else self.type


@brief
@dataclass(frozen=True)
class Done(Generic[Result]):
    """A job that has ended: its index, its result or error, and its wall time, measured where it ran."""

    index: int
    result: Result | None
    error: Failure | None
    seconds: float


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


def take_turns(
    count: int, room: int, start: Callable[[int], object], wait: Callable[[], Iterable[tuple[Done[Any], bool]]]
) -> Iterator[Done[Any]]:
    """Keep up to `room` jobs running and yield each that has ended; where its process died, it is tried once more.

    `wait` says which have ended since, and whether their processes died.
    """
    waiting, running = deque(range(count)), 0
    again: set[int] = set()
    while waiting or running:
        while waiting and running < room:
            start(waiting.popleft())
            running += 1
        for done, died in wait():
            running -= 1
            if died and done.index not in again:
                again.add(done.index)
                waiting.appendleft(done.index)
            else:
                yield done
