"""What `python -m benchmarks render` times: the backends, and splatting in plain torch as it is written elsewhere.

What it counts, too: the pairs of a Gaussian and a pixel that a render takes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache, partial
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs.functional import region_splat
from kcgs.kernels import SplatInputs, resolve
from kcgs.kernels.octaves import choose_levels, coarsen, direct, grids_of, most_spacing
from kcgs.kernels.whitened import support_radius
from kcgs.nn import RegionSplatRenderer
from kcgs.scene import Scene

from ._workloads import resized, standard, target_size
from .core.clocks import clock

PEER = "pair-list autograd"
# without coarse grids
DIRECT, EXACT = "cpu, direct", "tiled, direct"
# the truth, in float64: what it leaves out of a sum is far below float32's rounding
TRUTH_CUTOFF = 1e-12
# of the peer: it holds several tensors of as many elements at once
MOST_PAIRS = 60_000_000

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
    """Return a backend, or the peer, as a function (scene, cutoff) -> image; ", direct": without coarse grids."""

    def render(scene: Scene, cutoff: float) -> Tensor:
        field = scene.field
        with _grids(name):  # the backward goes by the same plan
            return region_splat(
                field.means, field.cholesky, field.colors, field.region_ids, scene.regions,
                size=scene.size, cutoff=cutoff, backend=name.partition(", ")[0],
            )  # fmt: skip

    return splat_pairs if name == PEER else render


def _grids(name: str) -> AbstractContextManager[None]:
    return direct() if name in (DIRECT, EXACT) else nullcontext()


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
    """Time a backend or the peer after one run to warm up."""
    return [once(renderer(name), scene, cutoff)[0] for _ in range(rounds + 1)][1:]


def second(action: Callable[[], object]) -> float:
    """Run twice and return the seconds of the second: the first finds caches, maybe a processor, taken by others."""
    action()
    return clock(action)


@torch.no_grad()
def forward(name: str, scene: Scene, cutoff: float) -> tuple[Tensor, list[Tensor]]:
    """Render only; no gradients."""
    return renderer(name)(scene, cutoff), []


def both(name: str, scene: Scene, cutoff: float) -> tuple[Tensor, list[Tensor]]:
    """Render and differentiate: image, gradients."""
    return once(renderer(name), scene, cutoff)[1:]


def in_turns(scene: Scene, cutoff: float, rounds: int) -> tuple[list[Timing], list[Timing]]:
    """Time the CPU kernel alone, and the module with autograd around it, in turns after one run each to warm up."""
    field, regions, module = scene.field, scene.regions, RegionSplatRenderer(cutoff, backend="cpu")
    assert regions is not None and field.region_ids is not None
    means, cholesky, colors = (t.detach() for t in (field.means, field.cholesky, field.colors))
    index = regions.index_of(field.region_ids)
    inputs = SplatInputs(means, cholesky, colors, index, regions.membership, scene.size, cutoff)
    steps, probe = resolve("cpu", inputs), probe_of(scene.size, colors.shape[-1], colors.dtype)

    def alone() -> Timing:
        start = time.perf_counter()
        plan = steps.plan(inputs)
        _image = steps.render(plan, inputs)
        middle = time.perf_counter()
        steps.differentiate(plan, inputs, probe, True)
        return Timing(middle - start, time.perf_counter() - middle)

    found = [(alone(), once(lambda *_: module(field, regions), scene, cutoff)[0]) for _ in range(rounds + 1)][1:]
    return [kernel for kernel, _ in found], [around for _, around in found]


def prepare(name: str, case: str, cutoff: float, size: str = "native") -> Callable[[], object]:
    """Return what renders and differentiates a standard workload or, at another size than its own, renders it."""
    scene = standard(case)
    if size != "native":
        return partial(forward, name, resized(scene, target_size(scene, size)), cutoff)
    probe_of(scene.size, 3, torch.float32)
    return partial(both, name, scene, cutoff)


def pairs_per_pixel(name: str, scene: Scene, cutoff: float) -> float:
    """Count the pairs of a Gaussian and a pixel, or a node of its grid, and divide by the pixels of the image.

    A pair counts where the weight, that of the region left out, is at least the cutoff, and the pixel is in the image
    or the node on the grid.
    """
    means, cholesky = scene.field.means.detach().double(), scene.field.cholesky.detach().double()
    grids, radius, found = grids_of(scene.size, 1), support_radius(cutoff, torch.float32), 0
    with _grids(name):
        level = choose_levels(cholesky, most_spacing(cutoff), len(grids))
    for number, grid in enumerate(grids):
        which = level == number
        places, factors = means[which], cholesky[which]
        if number:
            _, places, factors, _ = coarsen(level[which], places, factors)
        found += _count_inside(places, factors, radius, (grid.height, grid.width))
    return found / math.prod(scene.size)


def _count_inside(means: Tensor, cholesky: Tensor, radius: float, size: tuple[int, int]) -> int:
    """Count the pixel centres within each ellipse, row by row."""
    l11, l21, l22 = cholesky.unbind(-1)
    height = torch.hypot(l21, l22)
    first = (means[:, 1] - radius * height - 0.5).ceil().clamp_min(0)
    rows = ((means[:, 1] + radius * height - 0.5).floor().clamp_max(size[0] - 1) - first + 1).clamp_min(0).long()
    which = torch.repeat_interleave(rows)
    dy = first[which] + torch.arange(len(which)) - (rows.cumsum(0) - rows)[which] + 0.5 - means[which, 1]
    half = (radius**2 - (dy / height[which]) ** 2).clamp_min(0).sqrt() * (l11 * l22 / height)[which]
    middle = means[which, 0] + (l11 * l21 / height**2)[which] * dy - 0.5
    low, high = (middle - half).ceil().clamp_min(0), (middle + half).floor().clamp_max(size[1] - 1)
    return int((high - low + 1).clamp_min(0).sum())


def splat_pairs(scene: Scene, cutoff: float) -> Tensor:
    """Evaluate a list of (pixel, Gaussian) pairs, those in each Gaussian's bounding box, and add up by index."""
    (height, width), field, regions = scene.size, scene.field, scene.regions
    assert regions is not None and field.region_ids is not None
    low, span = _boxes(scene, cutoff)
    counts = span.prod(-1)
    gaussian = torch.repeat_interleave(counts)
    rank = torch.arange(len(gaussian)) - (counts.cumsum(0) - counts)[gaussian]
    y = low[gaussian, 1] + rank // span[gaussian, 0]
    x = low[gaussian, 0] + rank % span[gaussian, 0]
    pixel = y * width + x
    keep = regions.labels.flatten()[pixel] == field.region_ids[gaussian]
    pixel, gaussian = pixel[keep], gaussian[keep]
    means, (l11, l21, l22) = field.means[gaussian], field.cholesky[gaussian].unbind(-1)
    dx, dy = pixel % width + 0.5 - means[:, 0], pixel // width + 0.5 - means[:, 1]
    z1 = dx / l11
    z2 = (dy - l21 * z1) / l22
    weight = torch.exp(-0.5 * (z1 * z1 + z2 * z2))
    weight = torch.where(weight >= cutoff, weight, 0.0)
    image = field.colors.new_zeros(height * width, field.colors.shape[1])
    image = image.index_add(0, pixel, weight[:, None] * field.colors[gaussian])
    return image.T.reshape(-1, height, width)


def peer_fits(scene: Scene, cutoff: float) -> bool:
    """Whether the peer has memory enough for the pairs that it holds."""
    return int(_boxes(scene, cutoff)[1].prod(-1).sum()) <= MOST_PAIRS


def _boxes(scene: Scene, cutoff: float) -> tuple[Tensor, Tensor]:
    means, (l11, l21, l22) = scene.field.means.detach(), scene.field.cholesky.detach().unbind(-1)
    extent = torch.stack([l11, torch.hypot(l21, l22)], -1) * math.sqrt(-2 * math.log(cutoff))
    last = torch.tensor([scene.size[1] - 1, scene.size[0] - 1])
    low = (means - extent - 0.5).ceil().long().clamp_min(0)
    high = (means + extent - 0.5).floor().long().minimum(last)
    return low, (high - low + 1).clamp_min(0)
