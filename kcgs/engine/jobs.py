"""Independent jobs on the engines local and ray.

Importing this module loads no torch: a worker process sets its number of threads first.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import islice
from typing import Any, TypeVar

from kcgs.errors import InvalidArgument

Job = TypeVar("Job")
Result = TypeVar("Result")

_ENGINES = ("local", "ray")
# libraries read these once, when they are loaded
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_KILLED = "a worker process was killed, perhaps because memory ran out: the same command goes on where it stopped"


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    engine: str = "local",
    workers: int | None = None,
    threads: int = 1,
    gpus: int = 0,
) -> Iterator[tuple[int, Result]]:
    """Run independent jobs, and yield the index and the result of each as it ends.

    Convention: an exception in a job ends the iteration, so a job that may fail returns its error, and writes its
    output to disk. Every job runs on `threads` threads, so that it has the same result on either engine. With more than
    one worker, and on Ray, functions, jobs and results are pickled, and a script must guard its main part by
    ``if __name__ == "__main__":``.

    Args:
        function: called with one job; importable by name where there are worker processes.
        jobs: the arguments of the calls.
        engine: ``local``; or ``ray``: on the cluster at RAY_ADDRESS, or on one of this machine, shut down at the end.
        workers: jobs at a time. None: 1 locally, on Ray as many as fit. With 1, ``local`` runs in this process.
        threads: number of threads of each job.
        gpus: number of GPUs of each job on Ray, which assigns them; a local job chooses its own.

    Returns:
        An iterator over all jobs in the order in which they end. The first job starts with the first `next`.

    Raises:
        ValueError: unknown engine, workers or threads below 1.
        ImportError: engine ``ray`` without the package ray.
        RuntimeError: while iterating, a worker process was killed.

    Example:
        >>> list(run_jobs(str.upper, ["a", "b"]))
        [(0, 'A'), (1, 'B')]
    """
    if engine not in _ENGINES:
        raise InvalidArgument("engine", f"one of {', '.join(_ENGINES)}", repr(engine))
    for name, count in (("workers", workers), ("threads", threads)):
        if count is not None and count < 1:
            raise InvalidArgument(name, "at least 1", count)
    if engine == "ray":
        try:
            from ray.util.multiprocessing import Pool
        except ImportError as error:
            raise ImportError("engine 'ray' needs the package ray: pip install ray") from error
        return _on_cluster(Pool, function, jobs, workers, threads, gpus)
    if workers is None or workers == 1:
        return _in_this_process(function, jobs, threads)
    return _in_worker_processes(function, jobs, workers, threads)


def _in_this_process(
    function: Callable[[Job], Result], jobs: Sequence[Job], threads: int
) -> Iterator[tuple[int, Result]]:
    import torch

    before = torch.get_num_threads()
    for index, job in enumerate(jobs):
        torch.set_num_threads(threads)
        try:
            result = function(job)
        finally:
            torch.set_num_threads(before)
        yield index, result


def _in_worker_processes(
    function: Callable[[Job], Result], jobs: Sequence[Job], workers: int, threads: int
) -> Iterator[tuple[int, Result]]:
    # spawn: torch's threads do not survive a fork
    context = multiprocessing.get_context("spawn")
    queue, running = enumerate(jobs), dict[Future[Result], int]()
    with ProcessPoolExecutor(workers, context, _start_worker, (threads,)) as pool:
        try:
            while True:
                # at most one job per worker is submitted: jobs that wait inside a pool cannot be cancelled
                for index, job in islice(queue, workers - len(running)):
                    running[pool.submit(function, job)] = index
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(future), future.result()
        except BrokenProcessPool as error:
            raise RuntimeError(_KILLED) from error


def _start_worker(threads: int) -> None:
    # Ctrl-C reaches every process of a terminal: a worker ends without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, str(threads)))
    _set_threads(threads)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    # a worker ends with its parent, even in the middle of a fit: sys.exit would end this thread alone
    os._exit(1)


def _set_threads(threads: int) -> None:
    import torch

    torch.set_num_threads(threads)


def _on_cluster(
    pool_type: Any, function: Callable[[Job], Result], jobs: Sequence[Job], workers: int | None, threads: int, gpus: int
) -> Iterator[tuple[int, Result]]:
    import ray
    from ray.util.multiprocessing.pool import PoolTaskError

    starts_ray = not ray.is_initialized()
    if starts_ray:
        options: dict[str, Any] = {"address": os.environ.get("RAY_ADDRESS", "local")}
        if options["address"] == "local":
            # no usage report to the makers of Ray
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            options |= {"num_cpus": workers and workers * threads, "include_dashboard": False}
            # Ray's workers get this process's sys.path, as spawned processes do
            options["runtime_env"] = {"env_vars": {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}}
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    try:
        nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
        needs = {"CPU": threads, "GPU": gpus}
        capacity = sum(
            min(int(node["Resources"].get(name, 0)) // count for name, count in needs.items() if count)
            for node in nodes
            if node["Alive"]
        )
        if capacity == 0:
            needed = f"at most the processors of a node of the cluster{' with a GPU' if gpus else ''}"
            raise InvalidArgument("threads", needed, threads)
        size, resources = min(workers or capacity, capacity), {"num_cpus": threads, "num_gpus": gpus}
        with pool_type(size, _set_threads, (threads,), ray_remote_args=resources) as pool:
            for outcome in pool.imap_unordered(partial(_run_numbered, function), list(enumerate(jobs)), 1):
                if isinstance(outcome, PoolTaskError):
                    raise outcome.underlying
                if isinstance(outcome, ray.exceptions.RayTaskError):
                    raise outcome
                if isinstance(outcome, ray.exceptions.RayError):
                    raise RuntimeError(_KILLED) from outcome
                yield outcome
    finally:
        if starts_ray:
            ray.shutdown()


def _run_numbered(function: Callable[[Job], Result], job: tuple[int, Job]) -> tuple[int, Result]:
    return job[0], function(job[1])
