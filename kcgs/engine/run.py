"""The one way to do jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

from kcgs._check import check_count

from . import cluster, pool
from .jobs import ENGINES, Done, Job, Result, perform


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
        cluster.load()  # at once, not after the caller's preparations
        return cluster.run(function, jobs, workers, threads)
    if workers is None or workers == 1:
        return (perform(index, partial(function, job), threads) for index, job in enumerate(jobs))
    return pool.run(function, jobs, workers, threads)
