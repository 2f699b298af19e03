"""Jobs, what became of them, and the one function that callers use."""

from __future__ import annotations

import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import torch

from kcgs._check import check_count

Job = TypeVar("Job")
Result = TypeVar("Result")

ENGINES = ("local", "ray")


class Failure(NamedTuple):
    """Why there is no result: WorkerDied, without a traceback, where the process itself ended."""

    type: str
    message: str
    traceback: str

    def __str__(self) -> str:
        return f"{self.type}: {' '.join(self.message.split())}" if self.message else self.type


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


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    engine: str = "local",
    workers: int | None = None,
    threads: int | None = None,
) -> Iterator[Done[Result]]:
    """Do independent jobs, and yield each as it ends.

    Convention: a job that raises, or whose worker process is killed, takes no other with it. A killed worker is
    replaced and its job tried once more. Every job runs on `threads` threads, so that it has the same result on either
    engine. With more than one worker, and on Ray, functions, jobs and results are pickled, and a script must guard its
    main part by ``if __name__ == "__main__":``. Leaving the iterator early stops the jobs that run.

    Args:
        function: called with one job; importable by name where there are worker processes.
        jobs: what it is called with.
        engine: ``local``, or ``ray``: on the cluster at RAY_ADDRESS, or one on this machine that is shut down again.
        workers: jobs at a time. None: 1 locally, on Ray what its processors allow. With 1, ``local`` is this process.
        threads: of each job; None: 1.

    Returns:
        An iterator over all jobs in the order in which they end; nothing runs before the first is asked for.

    Raises:
        ValueError: unknown engine, workers or threads below 1.
        ImportError: engine ``ray`` without the package ray.

    Example:
        >>> [done.result for done in run_jobs(str.upper, ["a", "b"])]
        ['A', 'B']
        >>> [str(done.error) for done in run_jobs(int, ["7", "seven"])]
        ['None', "ValueError: invalid literal for int() with base 10: 'seven'"]
    """
    if engine not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(ENGINES)}; got {engine!r}")
    if workers is not None:
        check_count("workers", workers)
    threads = 1 if threads is None else check_count("threads", threads)
    if engine == "ray":
        from . import cluster

        cluster.load()  # at once, not after the caller's preparations
        return cluster.run(function, jobs, workers, threads)
    if workers is None or workers == 1:
        return (perform(index, partial(function, job), threads) for index, job in enumerate(jobs))
    from . import pool

    return pool.run(function, jobs, workers, threads)
