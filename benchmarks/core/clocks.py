"""Clocks and memory."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import torch

Key = TypeVar("Key")
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


def milliseconds(actions: Mapping[Key, Callable[[], object]], rounds: int) -> dict[Key, float]:
    """Time actions, medians after a first call; they take turns, so that a change of the machine's speed meets all."""
    times: dict[Key, list[float]] = {key: [] for key in actions}
    for _ in range(rounds + 1):
        for key, action in actions.items():
            start = time.perf_counter()
            action()
            times[key].append(1e3 * (time.perf_counter() - start))
    return {key: median(values[1:]) for key, values in times.items()}


def peak_megabytes(action: Callable[..., object], *arguments: Any, warm_up: tuple[Any, ...]) -> float:
    """Measure, in a process of its own, what an action adds to the peak of memory after a call with `warm_up`.

    NaN where the system does not report it; Linux does.
    """
    if not _CLEAR.exists():
        return math.nan
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_peak, (action, arguments, warm_up))


def _peak(action: Callable[..., object], arguments: tuple[Any, ...], warm_up: tuple[Any, ...]) -> float:
    torch.set_num_threads(1)
    action(*warm_up)
    before = _megabytes("VmRSS")
    _CLEAR.write_text("5")  # the peak so far is that of the warm-up: start again from here
    action(*arguments)
    return _megabytes("VmHWM") - before


def _megabytes(field: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return float(next(line for line in lines if line.startswith(field)).split()[1]) / 1024
