"""Clocks and memory of what is compared."""

from __future__ import annotations

import math
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import torch

Key = TypeVar("Key")
Result = TypeVar("Result")
Prepare = Callable[..., Callable[[], object]]
_CLEAR = Path("/proc/self/clear_refs")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch run on `count` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def clock(action: Callable[[], object], timer: Callable[[], float] = time.perf_counter) -> float:
    """Return the seconds that an action takes."""
    start = timer()
    action()
    return timer() - start


def in_turns(actions: Mapping[Key, Callable[[], Result]], rounds: int) -> dict[Key, list[Result]]:
    """Call every action once in each round: the speed of a shared machine drifts, and the drift meets all alike."""
    results: dict[Key, list[Result]] = {key: [] for key in actions}
    for _ in range(rounds):
        for key, action in actions.items():
            results[key].append(action())
    return results


def median_ratio(values: Sequence[float], others: Sequence[float]) -> float:
    """Median of the ratios within each round."""
    return statistics.median(one / other for one, other in zip(values, others, strict=True))


def peak_bytes(prepare: Prepare, arguments: tuple[object, ...], warm_up: tuple[object, ...]) -> float:
    """Measure, in a process of its own and on one thread, how many bytes an action adds at its peak; NaN: not told.

    `prepare`, importable by name, returns the action; what it allocates itself does not count. It is called with
    `warm_up` first, so that libraries and compiled code do not count either, then with `arguments`.
    """
    if not _CLEAR.exists():
        return math.nan
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_peak, (prepare, arguments, warm_up))


def _peak(prepare: Prepare, arguments: tuple[object, ...], warm_up: tuple[object, ...]) -> float:
    torch.set_num_threads(1)
    prepare(*warm_up)()
    action = prepare(*arguments)
    before = _resident_bytes("VmRSS")
    # the peak so far is the parent's or that of the warm-up: start again from here
    _CLEAR.write_text("5")
    action()
    return _resident_bytes("VmHWM") - before


def _resident_bytes(field: str) -> float:
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return 1024 * float(next(line for line in status.splitlines() if line.startswith(field)).split()[1])
