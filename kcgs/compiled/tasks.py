"""Tasks that threads take from a shared counter, for compiled loops.

A compiled function receives `tasks`, int64, with a row per task. The first column is the number of tasks, counted from
the first, that must be done before the task of the row begins. The loop of the function is::

    k = first_task(tasks, counters)
    while k >= 0:
        ...  # task tasks[k]
        k = next_task(tasks, counters, k)

Any thread may take any task, so tasks that may run at the same time write to different memory.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from kcgs._numba_internals import cgutils

from .program import inner
from .threads import num_threads

# first column of tasks: number of tasks, counted from the first, that must be done before
START = 0
# columns of the tasks of `ranges`: first row and last + 1
FIRST_ROW = 1
END_ROW = 2

# places of counters
_TAKEN = 0
_DONE = 1  # so many tasks, from the first on, are known to be done
_FAILED = 2
_FLAGS = 3  # 1 for each task that is done

# number of taken tasks after a failure, larger than any number of tasks
_CANCELLED = 1 << 62

_MOST_RANGES = 256

# times that a thread yields before it sleeps, so that an interrupted thread finds a processor
_YIELDS = 400
_MICROSECONDS = 20  # of a sleep


def run_tasks(function: Callable[[Any, Any], None], tasks: Any, work: int | None = None, per_thread: int = 1) -> None:
    """Call function(tasks, counters) on this thread and on others; return when all is done.

    An exception in one thread ends the others after their present tasks, and reaches the caller.

    Args:
        function: a loop over tasks, see the module.
        tasks: see the module.
        work: number of rows, pairs or pixels; None: there are as many threads as tasks.
        per_thread: amount of work for which another thread is woken.
    """
    counters, errors, running = np.zeros(_FLAGS + len(tasks), np.int64), list[BaseException](), list[None]()

    def run() -> None:
        running.append(None)
        try:
            function(tasks, counters)
        except BaseException as error:
            errors.append(error)
            counters[_TAKEN], counters[_FAILED] = _CANCELLED, 1
        finally:
            running.pop()

    count = min(num_threads(), len(tasks) if work is None else 1 + work // per_thread)
    if count > 1:
        # a thread that starts too late finds no task, so the caller does not wait for it
        _helpers(os.getpid()).call(run, count - 1)
    run()
    if errors:
        while running:  # the other threads still write to memory that the caller is about to free
            time.sleep(1e-3)
        raise errors[0]


class _Helpers:
    """Threads that wait for work; an executor would take twice as long to wake one."""

    def __init__(self) -> None:
        self._work: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._count = 0
        self._lock = threading.Lock()

    def call(self, function: Callable[[], None], count: int) -> None:
        """Have so many threads call a function, or as many as the system lets start."""
        if self._count < count:
            self._start(count)
        for _ in range(min(count, self._count)):
            self._work.put(function)

    def _start(self, count: int) -> None:
        with self._lock, suppress(RuntimeError):  # too many run, or the interpreter ends
            while self._count < count:
                threading.Thread(target=self._serve, name="kcgs", daemon=True).start()
                self._count += 1

    def _serve(self) -> None:
        while True:
            self._work.get()()


@functools.cache
def _helpers(process: int) -> _Helpers:
    # by process, since threads do not survive a fork
    return _Helpers()


def phases(*parts: Any) -> Any:
    """Join the tasks of phases, (T, K) int64 each; the first column is the number of tasks of all phases before."""
    starts = np.repeat(np.cumsum([0, *map(len, parts[:-1])]), [len(part) for part in parts])
    return np.column_stack([starts, np.concatenate(parts)])


def chunks(count: int, size: int, most: int) -> Any:
    """Split a range into at most `most` parts of at least about `size`: first and last + 1, (T, 2) int64."""
    parts = min(max(-(-count // size), 1), most)
    ends = np.arange(parts + 1) * count // parts
    return np.column_stack([ends[:-1], ends[1:]])


@functools.lru_cache(maxsize=64)
def ranges(count: int, size: int) -> Any:
    """Return tasks of one phase: ranges of so many rows, each of at least about `size`, as first and last + 1."""
    return phases(chunks(count, size, _MOST_RANGES))


@intrinsic
def _add(typing_context, counters, place):
    """Add 1 to a counter atomically; return its value before."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.atomic_rmw("add", _pointer(context, builder, signature, arguments), _long(1), "seq_cst")

    return types.int64(counters, types.int64), generate


@intrinsic
def _read(typing_context, counters, place):
    """Return the value of a counter, which other threads change."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(_pointer(context, builder, signature, arguments), "acquire", 8)

    return types.int64(counters, types.int64), generate


@intrinsic
def _write(typing_context, counters, place, value):
    """Set a counter; a thread that reads it sees all that this thread wrote before."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store_atomic(arguments[2], _pointer(context, builder, signature, arguments), "release", 8)
        return context.get_dummy_value()

    return types.void(counters, types.int64, types.int64), generate


@intrinsic
def _yield_thread(typing_context):
    """Let another thread have the processor."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        _call(builder, "SwitchToThread" if os.name == "nt" else "sched_yield", [])
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def _sleep(typing_context):
    """Sleep for a moment."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        _call(builder, *(("Sleep", [0]) if os.name == "nt" else ("usleep", [_MICROSECONDS])))
        return context.get_dummy_value()

    return types.void(), generate


def _call(builder: Any, name: str, numbers: list[int]) -> None:
    """Call a function of the system on integers."""
    arguments = [ir.Constant(ir.IntType(32), number) for number in numbers]
    kind = ir.FunctionType(ir.IntType(32), [argument.type for argument in arguments])
    builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def _pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    return builder.gep(data, [arguments[1]])


def _long(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(64), value)


@inner
def _wait(counters, count):
    """Wait until so many tasks, from the first on, are done; return False if one has failed."""
    done: int = _read(counters, _DONE)  # type: ignore[call-arg]
    yields = 0
    while True:
        while done < count and _read(counters, _FLAGS + done) != 0:
            done += 1
        if done >= count:
            # another thread may write a smaller number here: some flags are then read again
            _write(counters, _DONE, done)
            return _read(counters, _FAILED) == 0
        if _read(counters, _FAILED) != 0:
            return False
        if yields < _YIELDS:
            _yield_thread()
        else:
            _sleep()
        yields += 1


@inner
def first_task(tasks, counters):
    """Take a task, and wait for those before it; return its number, or -1 when all are done or one has failed."""
    k: int = _add(counters, _TAKEN)  # type: ignore[call-arg]
    if k < len(tasks):
        return k if _wait(counters, tasks[k, START]) else -1
    _wait(counters, len(tasks))
    return -1


@inner
def next_task(tasks, counters, k):
    """Mark task k as done, and take another task, as `first_task` does."""
    _write(counters, _FLAGS + k, 1)  # type: ignore[call-arg]
    return first_task(tasks, counters)
