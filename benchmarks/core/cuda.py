"""What a GPU does: its time, its kernels, its memory, and its work as a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch.profiler import ProfilerActivity, profile

from .run import Row

Result = TypeVar("Result")
# calls before a capture: kernels are compiled, and sizes are known
_WARM_UP_CALLS = 3


def check_device(device: str) -> None:
    """Raise a ValueError where torch lacks the device."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("a benchmark of a GPU needs a CUDA device; torch finds none")


def synchronize() -> None:
    """Wait for the GPU, where there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def finish(action: Callable[[], object], calls: int = 1) -> None:
    """Call an action `calls` times, then wait for the GPU."""
    for _ in range(calls):
        action()
    synchronize()


def megabytes(action: Callable[[], object]) -> float:
    """Measure what an action adds at the peak of the GPU's memory."""
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    finish(action)
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def count_kernels(action: Callable[[], object], calls: int) -> Row:
    """Count the kernels of a call, its copies and fills, and the milliseconds in which the GPU works on them."""
    finish(action)
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        finish(action, calls)
    events = [e for e in profiler.events() or () if e.device_type.name == "CUDA" and not e.is_user_annotation]
    copies = sum(event.name.startswith("Mem") for event in events)
    milliseconds = sum(event.time_range.elapsed_us() for event in events) / 1e3
    return {
        "kernels": (len(events) - copies) / calls, "copies": copies / calls, "kernels_ms": milliseconds / calls
    }  # fmt: skip


def capture(action: Callable[[], Result]) -> tuple[torch.cuda.CUDAGraph, Result]:
    """Capture an action; every replay of the graph writes its result anew."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(_WARM_UP_CALLS):
            action()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        result = action()
    return graph, result
