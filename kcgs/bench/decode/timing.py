"""Clocks and memory of decoders."""

from __future__ import annotations

import math
import multiprocessing
import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch

from kcgs.bench.render.timing import _resident, threads

from .decoders import Draw, Files, open_decoder


class Entrant(NamedTuple):
    """Who runs: a decoder, its threads, its cutoff."""

    decoder: str
    threads: int
    cutoff: float


class Opening(NamedTuple):
    """Seconds from a file on disk: until ready to draw, until the first picture is there."""

    load: float
    first: float


def race(draws: Mapping[Entrant, Draw], repeats: int) -> dict[Entrant, list[float]]:
    """Time drawing in turns, so that the drift of a shared machine's speed meets all alike; seconds of each round.

    Each draws twice in its turn, and the second counts: the first finds the caches, and maybe a processor, still taken
    by the one before.
    """
    seconds: dict[Entrant, list[float]] = {entrant: [] for entrant in draws}
    for _ in range(repeats):
        for entrant, draw in draws.items():
            with threads(entrant.threads):
                draw()
                start = time.perf_counter()
                draw()
                seconds[entrant].append(time.perf_counter() - start)
    return seconds


def ratio(seconds: list[float], others: list[float]) -> float:
    """Median of the ratios within each round."""
    return statistics.median(one / other for one, other in zip(seconds, others, strict=True))


def opening(name: str, files: Files, size: tuple[int, int], repeats: int) -> Opening:
    """Time opening a decoder and its first picture, on one thread: medians after one to warm up."""
    runs = []
    with threads(1):
        for _ in range(repeats + 1):
            start = time.perf_counter()
            draw = open_decoder(name, files, size, 1)
            middle = time.perf_counter()
            draw()
            runs.append(Opening(middle - start, time.perf_counter() - start))
    return Opening(*(statistics.median(values) for values in zip(*runs[1:], strict=True)))


def peak_memory(name: str, files: Files, size: tuple[int, int], small: Files) -> float:
    """Measure, in a process of its own, how many MB opening a decoder and drawing one picture adds at its peak.

    Args:
        name: of the decoder.
        files: of the scene.
        size: of the picture.
        small: a scene to warm up with, so that libraries and compiled code do not count.

    Returns:
        MB; NaN where the system does not tell (it is asked through /proc).
    """
    if not Path("/proc/self/clear_refs").exists():
        return math.nan
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_peak, (name, files, size, small))


def _peak(name: str, files: Files, size: tuple[int, int], small: Files) -> float:
    torch.set_num_threads(1)
    open_decoder(name, small, (48, 64), 1)()
    before = _resident("VmRSS")
    # the peak so far is that of the warm-up: start again from here
    Path("/proc/self/clear_refs").write_text("5")
    open_decoder(name, files, size, 1)()
    return (_resident("VmHWM") - before) * 1024 / 1e6
