"""What `kcgs bench render` times: the backends, two peers in plain torch, and the most that the processor could do.

The peers are the two ways in which splatting in plain torch is written elsewhere, differentiated by autograd. The
limit is the arithmetic of the CPU kernel (`kcgs.kernels.cpu.simd`) with nothing read and nothing written.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from functools import lru_cache, partial
from threading import Thread
from typing import Any, NamedTuple

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from torch import Tensor

from kcgs.functional import region_splat
from kcgs.kernels import SplatInputs
from kcgs.kernels.cpu import simd
from kcgs.kernels.cpu.kernel import plan
from kcgs.kernels.cpu.loops import _enter_tile, _find_mask
from kcgs.kernels.cpu.simd import SIDE
from kcgs.nn import RegionSplatRenderer
from kcgs.scene import Scene

from ._workloads import standard
from .core.clocks import clock, threads

# of the peers: they hold several tensors of as many elements at once
MOST_PAIRS = 60_000_000
_CHANNELS = 3

Render = Callable[[Scene, float], Tensor]


class Timing(NamedTuple):
    """Seconds."""

    forward: float
    backward: float

    @property
    def sum(self) -> float:
        """Forward and backward."""
        return self.forward + self.backward


def backends() -> list[str]:
    """Backends that run on this machine."""
    return ["cpu", "tiled", *(["cuda"] if torch.cuda.is_available() else [])]


def renderer(name: str) -> Render:
    """Return a backend, or a peer, as a function (scene, cutoff) -> image."""

    def render(scene: Scene, cutoff: float) -> Tensor:
        field = scene.field
        return region_splat(
            field.means, field.cholesky, field.colors, field.region_ids, scene.regions,
            size=scene.size, cutoff=cutoff, backend=name,
        )  # fmt: skip

    return PEERS.get(name, render)


@lru_cache(maxsize=2)
def probe_of(size: tuple[int, int], channels: int, dtype: torch.dtype) -> Tensor:
    """Return the gradient of the image that all are differentiated with: smooth, of both signs."""
    ramp = torch.linspace(-1, 1, channels * size[0] * size[1], dtype=dtype)
    return torch.cos(40 * ramp).view(channels, *size)


def once(render: Render, scene: Scene, cutoff: float) -> tuple[Timing, Tensor, list[Tensor]]:
    """Render and differentiate once: times, image, gradients of means, cholesky and colors."""
    parameters = (scene.field.means, scene.field.cholesky, scene.field.colors)
    probe = probe_of(scene.size, parameters[2].shape[-1], parameters[2].dtype)
    scene.zero_grad(set_to_none=True)
    start = time.perf_counter()
    image = render(scene, cutoff)
    middle = time.perf_counter()
    image.backward(probe)
    end = time.perf_counter()
    gradients = [p.grad for p in parameters if p.grad is not None]
    return Timing(middle - start, end - middle), image.detach(), gradients


def timed(name: str, scene: Scene, cutoff: float, rounds: int) -> list[Timing]:
    """Time a backend or a peer after one run to warm up."""
    return [once(renderer(name), scene, cutoff)[0] for _ in range(rounds + 1)][1:]


def images_per_second(scene: Scene, cutoff: float, rounds: int) -> float:
    """Render without gradients, on two threads: the median rate."""
    render = RegionSplatRenderer(cutoff=cutoff, backend="cpu")
    with threads(2), torch.inference_mode():
        seconds = [clock(partial(render, scene)) for _ in range(rounds + 1)]
    return 1 / statistics.median(seconds[1:])


def prepare(name: str, case: str, cutoff: float) -> Callable[[], object]:
    """Return what renders and differentiates a standard workload."""
    scene = standard(case)
    probe_of(scene.size, 3, torch.float32)
    return partial(once, renderer(name), scene, cutoff)


def splat_densely(scene: Scene, cutoff: float) -> Tensor:
    """Evaluate every Gaussian at every pixel."""
    height, width = scene.size
    field, labels, region_ids = scene.field, *_regions(scene)
    pixel = torch.arange(height * width)
    weight = _weights(pixel[:, None], width, field.means, field.cholesky, cutoff)
    weight = weight * (labels[:, None] == region_ids)
    return (weight @ field.colors).T.reshape(-1, height, width)


def splat_pairs(scene: Scene, cutoff: float) -> Tensor:
    """Evaluate a list of (pixel, Gaussian) pairs, those in each Gaussian's bounding box, and add up by index."""
    height, width = scene.size
    field, labels, region_ids = scene.field, *_regions(scene)
    low, span = _boxes(scene, cutoff)
    counts = span[:, 0] * span[:, 1]
    gaussian = torch.repeat_interleave(counts)
    rank = torch.arange(len(gaussian)) - (counts.cumsum(0) - counts)[gaussian]
    y = low[gaussian, 1] + rank // span[gaussian, 0]
    x = low[gaussian, 0] + rank % span[gaussian, 0]
    pixel = y * width + x
    keep = labels[pixel] == region_ids[gaussian]
    pixel, gaussian = pixel[keep], gaussian[keep]
    weight = _weights(pixel, width, field.means[gaussian], field.cholesky[gaussian], cutoff)
    image = field.colors.new_zeros(height * width, field.colors.shape[1])
    image = image.index_add(0, pixel, weight[:, None] * field.colors[gaussian])
    return image.T.reshape(-1, height, width)


PEERS = {"pair-list autograd": splat_pairs, "dense autograd": splat_densely}


def held_pairs(peer: str, scene: Scene, cutoff: float) -> int:
    """Count the pairs that a peer holds in memory."""
    if peer == "dense autograd":
        return len(scene) * math.prod(scene.size)
    _, span = _boxes(scene, cutoff)
    return int((span[:, 0] * span[:, 1]).sum())


def _regions(scene: Scene) -> tuple[Tensor, Tensor]:
    assert scene.regions is not None and scene.field.region_ids is not None
    return scene.regions.labels.flatten(), scene.field.region_ids


def _weights(pixel: Tensor, width: int, means: Tensor, cholesky: Tensor, cutoff: float) -> Tensor:
    dx = pixel % width + 0.5 - means[:, 0]
    dy = pixel // width + 0.5 - means[:, 1]
    l11, l21, l22 = cholesky.unbind(-1)
    z1 = dx / l11
    z2 = (dy - l21 * z1) / l22
    weight = torch.exp(-0.5 * (z1 * z1 + z2 * z2))
    return torch.where(weight >= cutoff, weight, 0.0)


def _boxes(scene: Scene, cutoff: float) -> tuple[Tensor, Tensor]:
    means, (l11, l21, l22) = scene.field.means.detach(), scene.field.cholesky.detach().unbind(-1)
    extent = torch.stack([l11, torch.hypot(l21, l22)], -1) * math.sqrt(-2 * math.log(cutoff))
    last = torch.tensor([scene.size[1] - 1, scene.size[0] - 1])
    low = (means - extent - 0.5).ceil().long().clamp_min(0)
    high = (means + extent - 0.5).floor().long().minimum(last)
    return low, (high - low + 1).clamp_min(0)


def _registers(context: Any, builder: Any, signature: Any, arguments: Any, backward: bool) -> Any:
    start = ir.Constant(ir.IntType(64), 0)
    coefficients = simd._pointer(context, builder, signature.args[1], arguments[1], start)
    geometry = simd._Columns(builder, coefficients, arguments[2])
    color = simd._constant(0.5)
    count = _CHANNELS + 3 if backward else _CHANNELS
    row, sums, close = simd._rows(builder, start, arguments[0], [simd._constant(0.0)] * count)
    second, weight = geometry.weight(simd._middle(builder, builder.urem(row, ir.Constant(row.type, SIDE))), None)
    following = [simd._call(builder, "fma", weight, color, total) for total in sums[:_CHANNELS]]
    if backward:
        value = builder.fmul(color, color)
        for _ in range(_CHANNELS - 1):
            value = simd._call(builder, "fma", weight, color, value)
        value = builder.fmul(value, weight)
        moment = builder.fmul(value, second)
        total, along, square = sums[_CHANNELS:]
        following += [builder.fadd(total, value), builder.fadd(along, moment)]
        following.append(simd._call(builder, "fma", moment, second, square))
    out = close(following)
    mixed = out[0]
    for value in out[1:]:
        mixed = builder.fadd(mixed, value)
    return builder.extract_element(mixed, ir.Constant(ir.IntType(32), 0))


def _loop(backward: bool) -> Any:
    def typed(typing_context, rows, coefficients, lowest):  # type: ignore[no-untyped-def]
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return _registers(context, builder, signature, arguments, backward)

        return types.float32(types.int64, coefficients, types.float32), generate

    return intrinsic(typed)


_forward, _backward = _loop(False), _loop(True)


@njit(nogil=True)
def _spin(rows, coefficients, lowest, backward):  # type: ignore[no-untyped-def]
    return _backward(rows, coefficients, lowest) if backward else _forward(rows, coefficients, lowest)


def limit_seconds(pairs: float, *, backward: bool, threads: int = 1) -> float:
    """Measure how long this many (pixel, Gaussian) pairs take in registers, each thread with an equal share."""
    coefficients = np.array([0.1, 0.01, 0.1, 0.01, 0.02], np.float32)
    rows = round(pairs / SIDE / threads)

    def spin() -> None:
        _spin(rows, coefficients, np.float32(-20.0), backward)

    others = [Thread(target=spin) for _ in range(threads - 1)]
    start = time.perf_counter()
    for other in others:
        other.start()
    spin()
    for other in others:
        other.join()
    return time.perf_counter() - start


@njit
def _rows_visited(lists, height, width):  # type: ignore[no-untyped-def]
    rows, cols = -(-height // SIDE), -(-width // SIDE)
    coefficients = np.empty(5, np.float32)
    total = 0
    for row in range(rows):
        for e in range(lists.start[row], lists.start[row + 1]):
            i = lists.entries[e, 0]
            for col in range(lists.entries[e, 1], lists.entries[e, 2]):
                if lists.num_regions > 0 and not _find_mask(lists, row * cols + col, lists.regions[i])[1]:
                    continue
                first, last = _enter_tile(lists.gaussians[i], row, col, height, width, lists.radius, coefficients)
                total += max(0, last - first)
    return total


def kernel_inputs(scene: Scene, cutoff: float) -> SplatInputs:
    """Return what the kernel is called with."""
    field, regions = scene.field, scene.regions
    assert regions is not None and field.region_ids is not None
    index = regions.index_of(field.region_ids)[None]
    means, cholesky, colors = (t.detach()[None] for t in (field.means, field.cholesky, field.colors))
    return SplatInputs(means, cholesky, colors, index, regions.membership, scene.size, cutoff)


def evaluated_pairs(scene: Scene, cutoff: float) -> int:
    """Count the (pixel, Gaussian) pairs that the CPU kernel evaluates: whole rows of 16 pixels."""
    return int(_rows_visited(plan(kernel_inputs(scene, cutoff)).lists, *scene.size)) * SIDE
