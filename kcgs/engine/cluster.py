"""Jobs on a Ray cluster: that of RAY_ADDRESS, or one on this machine for as long as it is needed."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import Any

from .jobs import Done, Failure, environment, perform, take_turns


def load() -> ModuleType:
    """Import ray, or say how to install it."""
    try:
        import ray
    except ImportError as error:
        raise ImportError("engine 'ray' needs the package ray: pip install 'kcgs[ray]'") from error
    return ray


@contextmanager
def connected(workers: int | None, threads: int) -> Iterator[ModuleType]:
    """Yield ray with a cluster behind it; what was started or joined here is left again.

    A cluster that is started has processors for `workers` jobs of `threads` each; None: all of this machine.
    """
    ray = load()
    if ray.is_initialized():
        yield ray
        return
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    address = os.environ.get("RAY_ADDRESS", "local")
    if address == "local":
        # usage reports go to Ray's makers, which who runs a fit has not asked for
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        processors = max(threads, os.cpu_count() or 1) if workers is None else workers * threads
        # what can be imported here can be imported there, as in worker processes of the engine local
        with environment({"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}):
            ray.init(address="local", num_cpus=processors, include_dashboard=False, **quiet)
    else:
        ray.init(address=address, **quiet)
    try:
        yield ray
    finally:
        ray.shutdown()


def run(function: Callable[[Any], Any], jobs: Sequence[Any], workers: int | None, threads: int) -> Iterator[Done[Any]]:
    """Do the jobs on the cluster; yield each as it ends."""
    with connected(workers, threads) as ray:
        # tried again here, not by Ray, which would do so for ever where memory runs out
        remote = ray.remote(perform).options(num_cpus=threads, max_retries=0)
        room = _room(ray, threads) if workers is None else workers
        running: dict[Any, tuple[int, float]] = {}

        def start(index: int) -> None:
            answer = remote.remote(index, partial(function, jobs[index]), threads)
            running[answer] = index, time.perf_counter()

        def ended() -> Iterator[tuple[Done[Any], bool]]:
            for answer in ray.wait(list(running), num_returns=1)[0]:
                yield _take(ray, answer, *running.pop(answer))

        try:
            yield from take_turns(len(jobs), room, start, ended)
        finally:
            for answer in running:
                ray.cancel(answer, force=True)


def _room(ray: ModuleType, threads: int) -> int:
    processors = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
    if 0 < max(processors) < threads:
        raise ValueError(f"threads must be at most {max(processors)}, what a node of the cluster has; got {threads}")
    return max(1, sum(count // threads for count in processors))


def _take(ray: ModuleType, answer: Any, index: int, since: float) -> tuple[Done[Any], bool]:
    """Return what became of a job, and whether its process died."""
    try:
        return ray.get(answer), False
    except ray.exceptions.RayTaskError as error:  # the job could not be read, or its result not be sent
        failure, died = Failure(type(error.cause).__name__, str(error.cause), str(error)), False
    except ray.exceptions.RayError as error:
        message = f"the worker process was ended, twice: {type(error).__name__}"
        failure, died = Failure("WorkerDied", message, str(error)), True
    return Done(index, None, failure, time.perf_counter() - since), died
