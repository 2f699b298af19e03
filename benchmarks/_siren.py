"""An image as a small network with sine activations (SIREN), stored at half precision, as COIN does."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import torch
from torch import Tensor, nn

BYTES_PER_WEIGHT = 2
_FREQUENCY = 30.0
_LAYERS = 3  # hidden ones
_BATCH = 16_384
_RATE = 1e-3


class Trained(NamedTuple):
    """What training came to."""

    render: Tensor  # (3, H, W) in [0, 1], of the rounded weights
    bytes: int
    width: int
    iterations: int
    seconds: float
    history: list[tuple[float, Tensor]]  # seconds, render


class Sine(nn.Module):
    """A linear layer and a sine, with the publication's start."""

    def __init__(self, inputs: int, outputs: int, first: bool) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        bound = 1 / inputs if first else math.sqrt(6 / inputs) / _FREQUENCY
        nn.init.uniform_(self.linear.weight, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., inputs) to (..., outputs)."""
        return torch.sin(_FREQUENCY * self.linear(x))


def weights_of(width: int) -> int:
    """Count the weights of a network."""
    return (2 * width + width) + (_LAYERS - 1) * (width * width + width) + (3 * width + 3)


def width_for(size: int) -> int:
    """Return the widest network that `size` bytes hold, at least 1."""
    width = 1
    while BYTES_PER_WEIGHT * weights_of(width + 1) <= size:
        width += 1
    return width


def train(image: Tensor, size: int, *, seconds: float, seed: int = 0) -> Trained:
    """Train a network of at most `size` bytes on random pixels for so many processor seconds, renders not counted."""
    generator = torch.Generator().manual_seed(seed)
    width = width_for(size)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = [Sine(2 if i == 0 else width, width, i == 0) for i in range(_LAYERS)]
        network = nn.Sequential(*layers, nn.Linear(width, 3))
    y, x = ((torch.arange(count) + 0.5) / count * 2 - 1 for count in image.shape[1:])
    points = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1).flatten(0, 1)
    colors = image.flatten(1).T.contiguous()
    optimizer = torch.optim.Adam(network.parameters(), lr=_RATE)
    spent, count, due, history = 0.0, 0, seconds / 64, list[tuple[float, Tensor]]()
    while spent < seconds:
        start = time.process_time()
        for group in optimizer.param_groups:
            group["lr"] = _RATE * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * spent / seconds)))
        index = torch.randint(len(points), (_BATCH,), generator=generator)
        optimizer.zero_grad()
        (network(points[index]) + 0.5 - colors[index]).square().mean().backward()
        optimizer.step()
        count, spent = count + 1, spent + time.process_time() - start
        if spent >= due:
            history.append((spent, _render(network, points, image)))
            due *= 2
    render = _render(network.half().float(), points, image)  # rounded, as it is stored
    return Trained(render, BYTES_PER_WEIGHT * weights_of(width), width, count, spent, [*history, (spent, render)])


def _render(network: nn.Module, points: Tensor, image: Tensor) -> Tensor:
    with torch.no_grad():
        colors: Tensor = torch.cat([network(part) for part in points.split(1 << 16)])
    return (colors.T.reshape(image.shape) + 0.5).clamp(0, 1)
