"""The CPU kernel as torch sees it: what the loops read, how threads share them, what they return.

The first call compiles, once for each machine and user, or loads the compiled code.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..inputs import Gradients, OutOfRangeError, SplatInputs, Steps
from ..membership import Membership
from ..threads import num_threads
from ..whitened import least_exponent, support_radius
from . import loops
from .loops import Lists
from .simd import SIDE

# fewer entries of the lists than this are left to the calling thread: waking another costs as much
_SERIAL_ENTRIES = 200


class _Plan(NamedTuple):
    lists: Lists
    order: Any  # [N] int64, sorted to given


def steps(inputs: SplatInputs) -> Steps:
    """Return the kernel, if it takes these inputs."""
    if inputs.means.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' computes in float32; got {inputs.means.dtype}: use 'tiled' or 'reference'")
    if inputs.means.device.type != "cpu":
        raise ValueError(f"backend 'cpu' needs tensors on the CPU; got {inputs.means.device}")
    loops.program.ready()
    return _STEPS


def plan(inputs: SplatInputs) -> _Plan:
    """List which Gaussians touch which tiles, for the loops."""
    batch, count = inputs.colors.shape[:-2].numel(), inputs.colors.shape[-2]
    height, width = inputs.size
    means, factors, colors = (_array(t) for t in inputs[:3])
    images = np.repeat(np.arange(batch), count)
    order = _sort(means, images, height, width)
    images = images[order]
    table = _NO_TABLE
    regions = np.zeros(batch * count, np.int64)
    if inputs.membership is not None and inputs.region_index is not None:
        table = inputs.membership.derived("cpu", _table)
        regions = inputs.region_index.flatten().numpy()[order]
    radius = support_radius(inputs.cutoff, torch.float32)
    lowest = np.float32(least_exponent(inputs.cutoff, torch.float32) / math.log(2))
    if not loops.in_range(means, factors, colors):
        raise OutOfRangeError
    gaussians, start, entries = loops.list_tiles(means, factors, order, regions, images, batch, height, width, radius)
    return _Plan(Lists(gaussians, colors[order].ravel(), regions, start, entries, *table, radius, lowest), order)


def _sort(means: Any, images: Any, height: int, width: int) -> Any:
    """Order by image, row of tiles and x: neighbours in the image become neighbours in memory."""
    rows = -(-height // SIDE)
    row = images * (rows + 2) + np.clip(np.floor(means[:, 1] / SIDE), -1, rows)
    # stable: what other Gaussians do must not change the order of these
    return np.argsort(row * (width + 2.0) + np.clip(means[:, 0], -1, width), kind="stable")


def _array(tensor: Tensor) -> Any:
    # contiguous, since every other layout would be compiled for
    return tensor.detach().resolve_neg().reshape(-1, tensor.shape[-1]).contiguous().numpy()


_NOTHING = np.zeros(1, np.int64)
_NO_TABLE = (0, 1, _NOTHING, _NOTHING, _NOTHING, np.zeros(1, np.float32))


def _table(membership: Membership) -> tuple[Any, ...]:
    tiles = membership.tiles(SIDE)
    maps, height, width = membership.index.shape
    keys = tiles.keys.numpy()
    count = maps * -(-height // SIDE) * -(-width // SIDE)
    start = np.searchsorted(keys, np.arange(count + 1) * membership.num_regions)
    masks = tiles.masks.to(torch.float32).flatten().numpy()
    return membership.num_regions, maps, keys, start, tiles.mask.numpy(), masks


def render(planned: _Plan, inputs: SplatInputs) -> Tensor:
    """Render (B, C, H, W)."""
    *batch, _, channels = inputs.colors.shape
    # numpy asks for huge pages where an array is large: first use costs a quarter of what torch.empty's does
    image = np.empty((*batch, channels, *inputs.size), np.float32)
    images = image.reshape(-1, *image.shape[-3:])
    _run_threads(lambda offset, step: loops.render(planned.lists, offset, step, images), planned.lists)
    return torch.from_numpy(image)


def differentiate(planned: _Plan, inputs: SplatInputs, grad: Tensor, geometry: bool) -> Gradients:
    """Give the gradients of means, cholesky (unless only colours are asked for) and colors."""
    channels = inputs.colors.shape[-1]
    terms = np.empty((len(planned.lists.entries), channels + (5 if geometry else 0)), np.float32)
    values = grad.resolve_neg().contiguous().numpy().reshape(-1, *grad.shape[-3:])
    _run_threads(lambda offset, step: loops.gather(planned.lists, offset, step, values, terms, geometry), planned.lists)
    means, cholesky, colors = (torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs[:3])
    flat = [t.view(-1, t.shape[-1]).numpy() for t in (means, cholesky, colors)]
    loops.finish(planned.lists, planned.order, terms, *flat)
    return (means, cholesky, colors) if geometry else (None, None, colors)


_STEPS = Steps(plan, render, differentiate, as_given=True)


@functools.cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    # by process, since threads do not survive a fork
    return ThreadPoolExecutor(threads, thread_name_prefix="kcgs")


def _run_threads(work: Callable[[int, int], None], lists: Lists) -> None:
    """Run work(offset, step) over all rows of tiles with torch's number of threads, the caller's among them."""
    threads = min(num_threads(), len(lists.start) - 1)
    if threads < 2 or len(lists.entries) < _SERIAL_ENTRIES:
        work(0, 1)
        return
    others = [_pool(os.getpid(), num_threads() - 1).submit(work, t, threads) for t in range(1, threads)]
    work(0, threads)
    for other in others:
        other.result()
