"""Clocks and memory."""

from __future__ import annotations

import math
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import region_splat
from kcgs.kernels import SplatInputs
from kcgs.kernels.cpu import kernel
from kcgs.nn import GaussianField, RegionSplatRenderer

from .peers import PEERS
from .workloads import Workload, standard

Draw = Callable[[Workload, Tensor, Tensor, Tensor, float], Tensor]


class Timing(NamedTuple):
    """Medians in seconds."""

    forward: float
    backward: float

    @property
    def sum(self) -> float:
        """Forward and backward."""
        return self.forward + self.backward


def drawer(name: str) -> Draw:
    """Return a backend, or a peer, as a function (scene, means, cholesky, colors, cutoff) -> image."""
    if name in PEERS:
        return PEERS[name]

    def draw(scene: Workload, means: Tensor, cholesky: Tensor, colors: Tensor, cutoff: float) -> Tensor:
        return region_splat(means, cholesky, colors, scene.region_ids, scene.regions, cutoff=cutoff, backend=name)

    return draw


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Run with `count` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def once(draw: Draw, scene: Workload, cutoff: float, probe: Tensor) -> tuple[Timing, Tensor, list[Tensor]]:
    """Draw and differentiate once: times, image, gradients."""
    inputs = [t.detach().requires_grad_() for t in (scene.means, scene.cholesky, scene.colors)]
    start = time.perf_counter()
    image = draw(scene, inputs[0], inputs[1], inputs[2], cutoff)
    middle = time.perf_counter()
    image.backward(probe)
    end = time.perf_counter()
    gradients = [t.grad for t in inputs if t.grad is not None]
    return Timing(middle - start, end - middle), image.detach(), gradients


def probe_of(scene: Workload) -> Tensor:
    """Make the gradient of the image that all are differentiated with: smooth, of both signs, in the scene's dtype."""
    height, width = scene.regions.size
    ramp = torch.linspace(-1, 1, 3 * height * width, dtype=scene.means.dtype)
    return torch.cos(40 * ramp).view(3, height, width)


def medians(name: str, scene: Workload, cutoff: float, repeats: int) -> Timing:
    """Time a backend: one run to warm up, then the medians of `repeats`."""
    draw, probe = drawer(name), probe_of(scene)
    runs = [once(draw, scene, cutoff, probe)[0] for _ in range(repeats + 1)][1:]
    return Timing(statistics.median(r.forward for r in runs), statistics.median(r.backward for r in runs))


def images_per_second(scene: Workload, cutoff: float, repeats: int) -> float:
    """Draw without gradients, on as many threads as torch has: the median rate."""
    field = GaussianField(scene.means, scene.cholesky, scene.colors, scene.region_ids, size=scene.regions.size)
    render = RegionSplatRenderer(cutoff=cutoff, backend="cpu")
    seconds = []
    with torch.inference_mode():
        for _ in range(repeats + 1):
            start = time.perf_counter()
            render(field, scene.regions)
            seconds.append(time.perf_counter() - start)
    return 1 / statistics.median(seconds[1:])


def overhead(scene: Workload, cutoff: float, repeats: int) -> tuple[float, float]:
    """Time the CPU kernel alone, and through the module and autograd: median seconds, forward and backward."""
    membership, size = scene.regions.membership, scene.regions.size
    index = scene.regions.index_of(scene.region_ids)[None]
    inputs = SplatInputs(scene.means[None], scene.cholesky[None], scene.colors[None], index, membership, size, cutoff)
    field = GaussianField(scene.means, scene.cholesky, scene.colors, scene.region_ids, size=size)
    render, probe = RegionSplatRenderer(cutoff=cutoff, backend="cpu"), probe_of(scene)
    alone, whole = [], []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        planned = kernel.plan(inputs)
        kernel.render(planned, inputs)
        kernel.differentiate(planned, inputs, probe[None], geometry=True)
        middle = time.perf_counter()
        field.zero_grad(set_to_none=True)
        render(field, scene.regions).backward(probe)
        alone.append(middle - start)
        whole.append(time.perf_counter() - middle)
    return statistics.median(alone[1:]), statistics.median(whole[1:])


def peak_memory(backend: str, workload: str, cutoff: float) -> float:
    """Measure, in a process of its own, how many MiB drawing and differentiating adds at its peak.

    Returns NaN where the system does not tell (it is asked through /proc).
    """
    if not Path("/proc/self/clear_refs").exists():
        return math.nan
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_peak, (backend, workload, cutoff))


def _peak(backend: str, workload: str, cutoff: float) -> float:
    torch.set_num_threads(1)
    small = standard("W3")
    once(drawer(backend), small, cutoff, probe_of(small))
    scene = standard(workload)
    probe = probe_of(scene)
    before = _resident("VmRSS")
    # the peak is inherited from the parent, and the warm-up has one of its own: start again from here
    Path("/proc/self/clear_refs").write_text("5")
    once(drawer(backend), scene, cutoff, probe)
    return (_resident("VmHWM") - before) / 1024


def _resident(field: str) -> int:
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(next(line for line in status.splitlines() if line.startswith(field)).split()[1])


__all__ = ["Timing", "drawer", "medians", "once", "peak_memory", "probe_of", "threads"]
