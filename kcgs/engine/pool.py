"""Worker processes of this machine.

Not concurrent.futures: there one killed process ends the whole pool, and nobody learns whose job it was.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any

from .jobs import Done, Failure, describe, environment, perform, take_turns

# seconds that a worker has to go by itself
_PATIENCE = 5.0
# libraries that read their number of threads once, as they are loaded
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class _Worker:
    """A process that does jobs until its pipe is closed."""

    def __init__(self, threads: int) -> None:
        # spawn: a fork would copy torch's and the kernel's threads half alive
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, threads), daemon=True)
        with environment(dict.fromkeys(_THREAD_VARIABLES, str(threads))):
            self.process.start()
        theirs.close()
        self.index: int | None = None
        self.since = 0.0

    def give(self, index: int, call: bytes) -> None:
        self.index, self.since = index, time.perf_counter()
        # a process that is gone already is found by whoever waits for its answer
        with suppress(OSError):
            self.pipe.send_bytes(pickle.dumps((index, call)))

    def take(self) -> Done[Any] | None:
        """Return the answer; None: the process is gone."""
        try:
            done: Done[Any] = pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            return None
        self.index = None
        return done

    def stop(self) -> None:
        self.pipe.close()
        if self.index is not None:
            self.process.terminate()
        self.process.join(_PATIENCE)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


def run(function: Callable[[Any], Any], jobs: Sequence[Any], workers: int, threads: int) -> Iterator[Done[Any]]:
    """Do the jobs in so many processes; yield each as it ends."""
    team: list[_Worker] = []

    def start(index: int) -> None:
        idle = next((worker for worker in team if worker.index is None), None)
        if idle is None:
            idle = _Worker(threads)
            team.append(idle)
        idle.give(index, pickle.dumps((function, jobs[index])))

    def ended() -> Iterator[tuple[Done[Any], bool]]:
        busy = {worker: worker.index for worker in team if worker.index is not None}
        found = wait([*(worker.pipe for worker in busy), *(worker.process.sentinel for worker in busy)])
        for worker, index in busy.items():
            if worker.pipe in found or worker.process.sentinel in found:
                done = worker.take()
                if done is None:
                    team.remove(worker)
                yield done or _obituary(worker, index), done is None

    try:
        yield from take_turns(len(jobs), workers, start, ended)
    finally:
        for worker in team:
            worker.stop()


def _obituary(worker: _Worker, index: int) -> Done[Any]:
    seconds = time.perf_counter() - worker.since
    worker.process.join(_PATIENCE)
    code = worker.process.exitcode
    worker.stop()
    how = f"with exit code {code}"
    if code is not None and code < 0:
        how = f"by {signal.Signals(-code).name}" + (", memory may have run out" if -code == signal.SIGKILL else "")
    return Done(index, None, Failure("WorkerDied", f"the worker process was ended {how}, twice", ""), seconds)


def _serve(pipe: Connection, threads: int) -> None:
    """Do jobs until the pipe is closed, which it also is when the caller is killed."""
    # Ctrl-C reaches every process of a terminal: it is for the caller, who stops the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            index, call = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            return
        done = perform(index, partial(_call, call), threads)
        try:
            answer = pickle.dumps(done)
        except Exception as raised:  # a result that cannot be pickled is a failure of its job alone
            answer = pickle.dumps(Done(index, None, describe(raised), done.seconds))
        try:
            pipe.send_bytes(answer)
        except OSError:
            return


def _call(call: bytes) -> Any:
    # read here, where what fails is the job's failure; plain pickle copies tensors, where multiprocessing's would
    # leave them in memory of a process that may end
    function, job = pickle.loads(call)
    return function(job)
