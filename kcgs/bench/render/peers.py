"""The two forms that splatting in plain torch takes elsewhere, differentiated by autograd."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .workloads import Workload

# several tensors of as many elements are held at once
MOST_PAIRS = 60_000_000


def dense(scene: Workload, means: Tensor, cholesky: Tensor, colors: Tensor, cutoff: float) -> Tensor:
    """Evaluate every Gaussian at every pixel."""
    height, width = scene.regions.size
    pixel = torch.arange(height * width)
    weight = _weights(pixel[:, None], width, means, cholesky, cutoff)
    weight = weight * (scene.regions.labels.flatten()[:, None] == scene.region_ids)
    return (weight @ colors).T.reshape(-1, height, width)


def pair_list(scene: Workload, means: Tensor, cholesky: Tensor, colors: Tensor, cutoff: float) -> Tensor:
    """Evaluate a list of (pixel, Gaussian) pairs, those in each Gaussian's bounding box, and add up by index."""
    height, width = scene.regions.size
    low, span = _boxes(means, cholesky, cutoff, height, width)
    counts = span[:, 0] * span[:, 1]
    gaussian = torch.repeat_interleave(counts)
    rank = torch.arange(len(gaussian)) - (counts.cumsum(0) - counts)[gaussian]
    y = low[gaussian, 1] + rank // span[gaussian, 0]
    x = low[gaussian, 0] + rank % span[gaussian, 0]
    pixel = y * width + x
    keep = scene.regions.labels.flatten()[pixel] == scene.region_ids[gaussian]
    pixel, gaussian = pixel[keep], gaussian[keep]
    weight = _weights(pixel, width, means[gaussian], cholesky[gaussian], cutoff)
    image = colors.new_zeros(height * width, colors.shape[1])
    image = image.index_add(0, pixel, weight[:, None] * colors[gaussian])
    return image.T.reshape(-1, height, width)


def pairs(name: str, scene: Workload, cutoff: float) -> int:
    """Count the pairs that a peer holds in memory."""
    height, width = scene.regions.size
    if name == "dense autograd":
        return len(scene.means) * height * width
    _, span = _boxes(scene.means, scene.cholesky, cutoff, height, width)
    return int((span[:, 0] * span[:, 1]).sum())


PEERS = {"pair-list autograd": pair_list, "dense autograd": dense}


def _weights(pixel: Tensor, width: int, means: Tensor, cholesky: Tensor, cutoff: float) -> Tensor:
    dx = pixel % width + 0.5 - means[:, 0]
    dy = pixel // width + 0.5 - means[:, 1]
    l11, l21, l22 = cholesky.unbind(-1)
    z1 = dx / l11
    z2 = (dy - l21 * z1) / l22
    weight = torch.exp(-0.5 * (z1 * z1 + z2 * z2))
    return torch.where(weight >= cutoff, weight, 0.0)


def _boxes(means: Tensor, cholesky: Tensor, cutoff: float, height: int, width: int) -> tuple[Tensor, Tensor]:
    l11, l21, l22 = cholesky.detach().unbind(-1)
    extent = torch.stack([l11, torch.hypot(l21, l22)], -1) * math.sqrt(-2 * math.log(cutoff))
    last = torch.tensor([width - 1, height - 1])
    low = (means.detach() - extent - 0.5).ceil().long().clamp_min(0)
    high = (means.detach() + extent - 0.5).floor().long().minimum(last)
    return low, (high - low + 1).clamp_min(0)
